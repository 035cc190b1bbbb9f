"""Files in object storage or on web servers: listed, read through a bounded local cache, written."""
