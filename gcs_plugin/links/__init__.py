"""Links to vehicles: UDP, TCP and serial transports, MAVLink packets, signing, telemetry logs."""
