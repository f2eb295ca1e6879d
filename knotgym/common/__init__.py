"""Shared foundations: errors, random streams, configurations, and file access."""
