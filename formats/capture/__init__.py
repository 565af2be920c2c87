"""Recording of serial ports and cameras into sessions."""
