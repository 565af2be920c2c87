"""Reports: solutions as one HTML file that opens anywhere, offline."""
