"""One module for each verb of the `orthoswarm` command: its arguments, and what it prints."""
