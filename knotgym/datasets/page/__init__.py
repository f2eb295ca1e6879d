"""A self-contained HTML page for browsing a dataset offline."""
