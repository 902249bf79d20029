"""What is seen: listen to the buses, decode, record, recover, export, serve logs. Never transmits on CAN."""
