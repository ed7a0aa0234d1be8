"""From a policy to fixed-point C: ranges, format, proof, bit-exact emulators, emitter, checks."""
