"""One HTML file to browse a dataset in, without a network."""
