"""What every room stands on: errors, random streams, configurations, files."""
