"""The `orthoswarm` command: `main` finds the verb; `verbs` has one module for each."""
