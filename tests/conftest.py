"""Settings of all tests: float64 unless a test asks otherwise, no silent rank promotion, two CPU devices."""

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_num_cpu_devices", 2)
