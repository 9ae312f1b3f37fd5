"""Flights without sockets: the law against the bundled physics in one process."""
