"""A map over the network: an HTTP service (extra `serve`) and its client."""
