"""What a vehicle is like, by least squares from the record of a flight: rates, thrust, drag, delays."""
