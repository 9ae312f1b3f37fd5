"""What a flight leaves behind: traffic log, summary, report."""
