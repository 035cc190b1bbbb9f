"""Photos and exposures of one flight matched, although clocks differ and some of both are missing."""
