"""From an area to straight-line coverage missions for a swarm (paper III.A): pure geometry in UTM metres."""
