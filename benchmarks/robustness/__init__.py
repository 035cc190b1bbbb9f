"""What damaged files, wrong maps and flights with faults do to the results."""
