"""The rope in a browser: pull it by hand, watch episodes, record them."""
