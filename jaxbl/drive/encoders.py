"""Position encoders with Gaussian noise and quantisation."""

import equinox as eqx
import jax
import jax.numpy as jnp

from .parameters import Scalar, ScalarArray, parameter


class Encoders(eqx.Module):
    """Encoders on motor and load shaft, sampled without delay: y = q round((theta + sigma n) / q).

    Here sigma is the rms noise of the side's encoder, q its count, and n a draw of a standard normal distribution.
    """

    noise: Scalar = parameter("rad", "rms noise of the motor encoder", default=0.0, minimum=0.0)
    load_noise: Scalar | None = parameter(
        "rad", "rms noise of the load encoder; left out: noise / gear_ratio", default=None, minimum=0.0
    )
    motor_resolution: Scalar = parameter("rad", "motor encoder count; 0 is ideal", default=0.0, minimum=0.0)
    load_resolution: Scalar = parameter("rad", "load encoder count; 0 is ideal", default=0.0, minimum=0.0)
    missed: Scalar | None = parameter(
        "", "share of readings that are missed, at random; left out: none", default=None, minimum=0.0, maximum=1.0
    )

    def noise_of(self, side: str, ratio: Scalar) -> Scalar:
        """Rms noise of a side's encoder, rad; `ratio` is the motor angle for one unit of the side's angle."""
        if side == "motor":
            return self.noise
        return self.noise / ratio if self.load_noise is None else self.load_noise

    def resolution_of(self, side: str) -> Scalar:
        """Count of a side's encoder, rad; further sides have the load's."""
        return self.motor_resolution if side == "motor" else self.load_resolution

    def measure(self, side: str, position: ScalarArray, unit_noise: ScalarArray, ratio: Scalar) -> ScalarArray:
        """Read a true position (rad).

        Args:
            side: of the encoder.
            position: true position, rad, as the effects of encoders change it.
            unit_noise: draw of a standard normal distribution, float32.
            ratio: motor angle for one unit of the side's angle.

        Returns:
            The reading, rad; NaN where it is missed.
        """
        noisy = position + self.noise_of(side, ratio) * unit_noise
        resolution = self.resolution_of(side)
        count = jnp.where(resolution > 0.0, resolution, 1.0)
        reading = jnp.where(resolution > 0.0, count * jnp.round(noisy / count), noisy)
        if self.missed is None:
            return reading
        # the last bits of a draw are as good as independent of it
        bits = jax.lax.bitcast_convert_type(unit_noise, jnp.int32) & 0xFFFF
        return jnp.where(bits < 0x10000 * self.missed, jnp.nan, reading)
