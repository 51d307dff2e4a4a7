"""The work folder: store, links, leases and lists."""
