"""A policy as a file on board (``.qjp``): writing, reading, and the C that loads and runs it."""
