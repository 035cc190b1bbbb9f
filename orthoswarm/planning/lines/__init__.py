"""Flight lines over an area: columns, boustrophedon cells, TMSTC*, their order, ways round zones, coverage check."""
