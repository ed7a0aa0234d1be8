"""Fixed-point C of a policy: ranges, format, proof, bit-exact emulators, emitter, checks."""
