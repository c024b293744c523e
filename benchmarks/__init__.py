"""Speed and accuracy against peers; run by hand and at night, never in `make test`."""
