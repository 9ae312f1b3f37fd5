"""MAVLink as bytes: framing, the hot messages, the vehicle's state, setpoints."""
