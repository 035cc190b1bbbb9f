"""The daemon's storage: journal, picture files, the workspace's lock; and the event bus for changes."""
