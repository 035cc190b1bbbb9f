"""The vehicles on the links: discovery, routing by system id, state, message rates, events."""
