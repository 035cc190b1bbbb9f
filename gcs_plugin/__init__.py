"""The ground station: command line, links, missions, daemon."""
