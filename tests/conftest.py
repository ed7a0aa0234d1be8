"""Eight host devices, for the tests of learners that share a batch among devices."""

import jax

jax.config.update("jax_num_cpu_devices", 8)  # before anything starts the backend
