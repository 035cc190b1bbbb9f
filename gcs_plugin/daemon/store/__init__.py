"""What the daemon keeps: journal, picture files, the workspace's lock; and the event bus that tells of changes."""
