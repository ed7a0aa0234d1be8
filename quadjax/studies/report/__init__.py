"""Tables and figures of flights: simulated ones, flights on the plant and flight logs alike."""
