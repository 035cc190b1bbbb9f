"""From inputs to frames: photos, pairing with logs, inspection."""
