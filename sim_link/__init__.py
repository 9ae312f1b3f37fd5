"""A simulated PX4 multirotor that speaks MAVLink over UDP."""
