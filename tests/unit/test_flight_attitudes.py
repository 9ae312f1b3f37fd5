"""ATTITUDE_QUATERNION is asked for as long as it brings something."""

from companion.flight.attitudes import SHARE_MIN, STATES_JUDGED, Attitudes


def verdicts(newer_every: int, states: int = 2 * STATES_JUDGED) -> list[int]:
    """States at which the stream was found to bring nothing; every so many-th had a newer attitude, 0: none."""
    attitudes, found = Attitudes(), []
    for i in range(1, states):
        ahead = newer_every > 0 and i % newer_every == 0
        attitudes.on_attitude(1000 * (i + ahead))
        if attitudes.waste(1000 * i):
            found.append(i)
    return found


def test_a_stream_that_is_never_newer_is_found_out_once() -> None:
    assert verdicts(0) == [STATES_JUDGED]
    assert verdicts(round(2.0 / SHARE_MIN)) == [STATES_JUDGED]


def test_one_that_is_newer_now_and_then_stays() -> None:
    assert verdicts(round(0.5 / SHARE_MIN)) == []
    assert verdicts(1) == []


def test_states_without_any_attitude_say_nothing() -> None:
    attitudes = Attitudes()
    assert not any(attitudes.waste(1000 * i) for i in range(3 * STATES_JUDGED))
    found = []
    for i in range(3 * STATES_JUDGED, 6 * STATES_JUDGED):
        attitudes.on_attitude(1000 * i)
        if attitudes.waste(1000 * i):
            found.append(i)
    assert found == [4 * STATES_JUDGED - 1]
