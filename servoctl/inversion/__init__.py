"""Which actuation moves the mechanism as the program asks: exactly, or as well as actuators and limits allow."""
