"""Software in the loop: exported C flies a simulated drone."""
