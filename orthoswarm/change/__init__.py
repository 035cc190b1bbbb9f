"""Where the ground is no longer what the pre-disaster map shows, and what has become of it."""
