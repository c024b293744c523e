"""Objects: vehicles found in the scans and followed."""
