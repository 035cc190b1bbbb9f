"""One module for each verb of the `orthoswarm` command; see gcs_plugin.cli."""
