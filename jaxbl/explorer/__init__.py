"""Studies in a browser: a folder that needs no Python, or a page served from this machine."""
