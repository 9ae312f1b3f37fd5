/* What the companion's latency is compared with, and what measures it. tools/bench.py compiles it with cc.

   echo PORT
       Answers every MAVLink 2 ODOMETRY at a UDP port of the loopback interface with a SET_ATTITUDE_TARGET: the least
       that any companion has to do. Checks the state's checksum and computes the setpoint's.

   relay HERE VEHICLE COMPANION [FRAME]
       Stands between a vehicle (its port VEHICLE, speaking to HERE) and a companion (listening at COMPANION), passes
       every datagram on, and stops the time from the moment before a state is passed on to the moment after its
       setpoint has come. It says "answered" after the first, and at its end prints a line per state: when it was
       passed on, and how long its answer took, -1 without one [ns]. FRAME, in hexadecimal digits, is sent to the
       vehicle first, for those who do not ask for states themselves.

   Both end at SIGTERM. */

#include <arpa/inet.h>
#include <errno.h>
#include <netinet/in.h>
#include <poll.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#define ODOMETRY 331
#define ODOMETRY_CRC_EXTRA 91
#define SET_ATTITUDE_TARGET 82
#define SET_ATTITUDE_TARGET_CRC_EXTRA 49
#define SETPOINT_BYTES 39
#define DATAGRAM_MAX 4096
#define STATES_MAX 1000000

static volatile sig_atomic_t ended = 0;

static void end(int number) {
    (void)number;
    ended = 1;
}

static void fail(const char *what) {
    perror(what);
    exit(1);
}

static uint16_t checksum(const uint8_t *data, size_t count, uint8_t extra) {
    uint16_t crc = 0xFFFF;
    for (size_t i = 0; i <= count; i++) {
        uint8_t byte = (i < count ? data[i] : extra) ^ (uint8_t)(crc & 0xFF);
        byte ^= (uint8_t)(byte << 4);
        crc = (uint16_t)((crc >> 8) ^ (uint16_t)(byte << 8) ^ (uint16_t)(byte << 3) ^ (uint16_t)(byte >> 4));
    }
    return crc;
}

static int64_t now_ns(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

static int bound(int port) {
    struct sockaddr_in here = {.sin_family = AF_INET, .sin_port = htons((uint16_t)port)};
    int s = socket(AF_INET, SOCK_DGRAM, 0);
    here.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    if (s < 0 || bind(s, (struct sockaddr *)&here, sizeof here) < 0) fail("socket");
    return s;
}

static void to(int s, int port) {
    struct sockaddr_in there = {.sin_family = AF_INET, .sin_port = htons((uint16_t)port)};
    there.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    if (connect(s, (struct sockaddr *)&there, sizeof there) < 0) fail("connect");
}

/* The frame of a message in a datagram of MAVLink 2 frames, NULL when there is none. */
static const uint8_t *find(const uint8_t *data, ssize_t count, uint32_t wanted) {
    ssize_t at = 0;
    while (at + 12 <= count && data[at] == 0xFD) {
        const uint8_t *frame = data + at;
        uint32_t msgid = frame[7] | (uint32_t)frame[8] << 8 | (uint32_t)frame[9] << 16;
        ssize_t length = frame[1] + 12 + (frame[2] & 1 ? 13 : 0);
        if (at + length > count) break;
        if (msgid == wanted) return frame;
        at += length;
    }
    return NULL;
}

/* Level attitude, no rates, half thrust, stamped with the state's time. */
static size_t setpoint(uint8_t *frame, const uint8_t *state, uint8_t seq) {
    static const uint8_t head[10] = {0xFD, SETPOINT_BYTES, 0, 0, 0, 1, 191, SET_ATTITUDE_TARGET, 0, 0};
    uint64_t t_us = 0;
    float numbers[8] = {1.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.5f};
    uint16_t crc;
    memcpy(&t_us, state + 10, state[1] < 8 ? state[1] : 8);
    uint32_t t_ms = (uint32_t)(t_us / 1000);
    memcpy(frame, head, sizeof head);
    frame[4] = seq;
    memcpy(frame + 10, &t_ms, 4);
    memcpy(frame + 14, numbers, sizeof numbers);
    frame[46] = state[5];
    frame[47] = 1;
    frame[48] = 0x80; /* ignore the attitude */
    crc = checksum(frame + 1, 9 + SETPOINT_BYTES, SET_ATTITUDE_TARGET_CRC_EXTRA);
    frame[49] = (uint8_t)(crc & 0xFF);
    frame[50] = (uint8_t)(crc >> 8);
    return 51;
}

static int echo(int port) {
    uint8_t data[DATAGRAM_MAX], answer[64], seq = 0;
    struct sockaddr_in sender;
    int s = bound(port);
    while (!ended) {
        socklen_t size = sizeof sender;
        ssize_t count = recvfrom(s, data, sizeof data, 0, (struct sockaddr *)&sender, &size);
        const uint8_t *state = count < 0 ? NULL : find(data, count, ODOMETRY);
        if (state == NULL) continue;
        uint16_t crc = checksum(state + 1, 9 + state[1], ODOMETRY_CRC_EXTRA);
        if (state[10 + state[1]] != (crc & 0xFF) || state[11 + state[1]] != crc >> 8) continue;
        size_t length = setpoint(answer, state, seq++);
        sendto(s, answer, length, 0, (struct sockaddr *)&sender, size);
    }
    return 0;
}

static void send_first(int vehicle, const char *hex) {
    uint8_t frame[280];
    size_t count = strlen(hex) / 2;
    if (count > sizeof frame) count = sizeof frame;
    for (size_t i = 0; i < count; i++) {
        unsigned int byte = 0;
        if (sscanf(hex + 2 * i, "%2x", &byte) != 1) return;
        frame[i] = (uint8_t)byte;
    }
    send(vehicle, frame, count, 0);
}

static int relay(int here, int vehicle_port, int companion_port, const char *first) {
    static int64_t sent_ns[STATES_MAX], took_ns[STATES_MAX];
    uint8_t data[DATAGRAM_MAX];
    int vehicle = bound(here), companion = bound(0), waiting = 0;
    long states = 0, answers = 0;
    struct pollfd both[2] = {{.fd = companion, .events = POLLIN}, {.fd = vehicle, .events = POLLIN}};
    to(vehicle, vehicle_port);
    to(companion, companion_port);
    if (first != NULL) send_first(vehicle, first);
    while (!ended) {
        if (poll(both, 2, -1) <= 0) continue;
        for (;;) {
            ssize_t count = recv(companion, data, sizeof data, MSG_DONTWAIT);
            int64_t at_ns = now_ns();
            if (count <= 0) break;
            if (waiting && find(data, count, SET_ATTITUDE_TARGET) != NULL) {
                took_ns[states - 1] = at_ns - sent_ns[states - 1];
                waiting = 0;
                answers++;
            }
            send(vehicle, data, (size_t)count, 0);
        }
        if (answers == 1) {
            answers++;
            puts("answered");
            fflush(stdout);
        }
        for (;;) {
            ssize_t count = recv(vehicle, data, sizeof data, MSG_DONTWAIT);
            if (count <= 0) break;
            if (states < STATES_MAX && find(data, count, ODOMETRY) != NULL) {
                took_ns[states] = -1;
                sent_ns[states++] = now_ns();
                waiting = 1;
            }
            send(companion, data, (size_t)count, 0);
        }
    }
    for (long i = 0; i < states; i++) printf("%lld %lld\n", (long long)sent_ns[i], (long long)took_ns[i]);
    return 0;
}

int main(int count, char **arguments) {
    struct sigaction action = {.sa_handler = end};
    sigaction(SIGTERM, &action, NULL);
    sigaction(SIGINT, &action, NULL);
    if (count == 3 && strcmp(arguments[1], "echo") == 0) return echo(atoi(arguments[2]));
    if ((count == 5 || count == 6) && strcmp(arguments[1], "relay") == 0)
        return relay(atoi(arguments[2]), atoi(arguments[3]), atoi(arguments[4]), count == 6 ? arguments[5] : NULL);
    fprintf(stderr, "usage: echo PORT | relay HERE VEHICLE COMPANION [FRAME]\n");
    return 2;
}
