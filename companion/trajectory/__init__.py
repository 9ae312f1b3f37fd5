"""References: what is to be flown, as functions of time with exact derivatives up to the fourth."""
