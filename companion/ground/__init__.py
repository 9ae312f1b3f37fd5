"""What an operator's tools talk to: `companion serve` at component 191, and the client that commands it."""
