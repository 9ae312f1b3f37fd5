"""A flight: the control loop, its phases and what it does when something goes wrong."""
