"""Pictures and poses into the daemon: posted, from streams, from watched folders, once each."""
