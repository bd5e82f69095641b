// The workload by hand on a GPU: a lane a thread, its state in registers, the loop over time inside. `real` is float or double.

struct Constants {
  double period, motor_inertia, motor_viscous, load_inertia, load_viscous, gear_ratio, stiffness, slope, share;
  double motor_error;
};

__device__ inline real sign_of(real x) { return (x > real(0)) - (x < real(0)); }

extern "C" __global__ void chain(Constants c, int steps, int start, int window, const real* __restrict__ torque,
                                 const real* __restrict__ noise, int lanes, const real* __restrict__ given,
                                 real* __restrict__ out) {
  const int lane = blockIdx.x * blockDim.x + threadIdx.x;
  if (lane >= lanes) return;
  const real h = c.period, half = real(0.5) * h, ratio = c.gear_ratio, share = c.share, stiffness = c.stiffness;
  const real slope = real(0.5) * real(c.slope);
  const real motor_mass = real(c.motor_inertia) / h, motor_drag = real(0.5) * real(c.motor_viscous);
  const real load_mass = real(c.load_inertia) / h, load_drag = real(0.5) * real(c.load_viscous);
  const real motor_keep = (motor_mass - motor_drag) / (motor_mass + motor_drag), motor_gain = real(1) / (motor_mass + motor_drag);
  const real load_keep = (load_mass - load_drag) / (load_mass + load_drag), load_gain = real(1) / (load_mass + load_drag);
  const real motor_inverse = real(1) / real(c.motor_inertia), load_friction = real(c.load_viscous / c.load_inertia);
  const real motor_alpha = given[lane], motor_lambda = given[lanes + lane], load_alpha = given[2 * lanes + lane];
  const real load_lambda = given[3 * lanes + lane], gap = real(4) * given[4 * lanes + lane];
  const real motor_noise = given[5 * lanes + lane], load_noise = motor_noise / ratio;
  real motor = 0, motor_rate = 0, load = 0, load_rate = 0, motor_seen = 0, load_seen = 0, load_guess = 0;
  real motor_guess = real(-c.motor_error), motor_control = 0, load_control = 0, twist = 0, bend = 0;
  real total[9] = {}, lost[9] = {};
  for (int begin = 0; begin < steps; begin += 512) {
    real recent[9] = {};
    const int end = min(begin + 512, steps);
    for (int i = begin; i < end; ++i) {
      const real u = torque[i];
      const real motor_read = motor + motor_noise * noise[2 * i], load_read = load + load_noise * noise[2 * i + 1];
      const real motor_off = motor_rate - motor_guess, load_off = load_rate - load_guess;
      motor += half * motor_rate, load += half * load_rate;
      const real z = motor - ratio * load;
      const real through = stiffness * (z - gap * tanh(slope * z));
      motor_rate = motor_keep * motor_rate + motor_gain * (u - through);
      load_rate = load_keep * load_rate + load_gain * (ratio * through);
      motor += half * motor_rate, load += half * load_rate;
      const real motor_miss = motor_read - motor_seen, load_miss = load_read - load_seen;
      const real motor_sign = sign_of(motor_miss), load_sign = sign_of(load_miss);
      const real motor_now = motor_alpha * motor_sign, load_now = load_alpha * load_sign;
      motor_seen += h * (motor_guess + motor_lambda * motor_sign * sqrt(abs(motor_miss)));
      load_seen += h * (load_guess + load_lambda * load_sign * sqrt(abs(load_miss)));
      motor_guess += h * ((u - real(c.motor_viscous) * motor_guess) * motor_inverse + motor_now);
      load_guess += h * (load_now - load_friction * load_guess);
      motor_control += share * (motor_now - motor_control);
      load_control += share * (load_now - load_control);
      if (i >= start) {
        const real motor_torque = real(-c.motor_inertia) * motor_control;
        const real load_torque = real(c.load_inertia / c.gear_ratio) * load_control;
        recent[0] += twist * twist, recent[1] += twist * bend, recent[2] += bend * bend;
        recent[3] += twist * motor_torque, recent[4] += bend * motor_torque;
        recent[5] += twist * load_torque, recent[6] += bend * load_torque;
      }
      if (i >= window) recent[7] += motor_off * motor_off, recent[8] += load_off * load_off;
      const real seen = motor_read - ratio * load_read;
      twist += share * (seen - twist);
      bend += share * (real(-4) * tanh(slope * seen) - bend);
    }
    for (int k = 0; k < 9; ++k) {
      const real corrected = recent[k] - lost[k], next = total[k] + corrected;
      lost[k] = (next - total[k]) - corrected;
      total[k] = next;
    }
  }
  for (int k = 0; k < 9; ++k) out[k * lanes + lane] = total[k];
}

// Lorenz's system by Runge and Kutta's classical method, as in the DiffEqGPU benchmark: rho differs from lane to lane.
extern "C" __global__ void lorenz(int steps, real step, int lanes, const real* __restrict__ rho, real* __restrict__ out) {
  const int lane = blockIdx.x * blockDim.x + threadIdx.x;
  if (lane >= lanes) return;
  const real r = rho[lane], sigma = 10, beta = real(8) / real(3);
  real x = 1, y = 0, z = 0;
  for (int i = 0; i < steps; ++i) {
    real ax = sigma * (y - x), ay = r * x - y - x * z, az = x * y - beta * z;
    real p = x + real(0.5) * step * ax, q = y + real(0.5) * step * ay, s = z + real(0.5) * step * az;
    const real bx = sigma * (q - p), by = r * p - q - p * s, bz = p * q - beta * s;
    p = x + real(0.5) * step * bx, q = y + real(0.5) * step * by, s = z + real(0.5) * step * bz;
    const real cx = sigma * (q - p), cy = r * p - q - p * s, cz = p * q - beta * s;
    p = x + step * cx, q = y + step * cy, s = z + step * cz;
    const real dx = sigma * (q - p), dy = r * p - q - p * s, dz = p * q - beta * s;
    x += step / real(6) * (ax + real(2) * (bx + cx) + dx);
    y += step / real(6) * (ay + real(2) * (by + cy) + dy);
    z += step / real(6) * (az + real(2) * (bz + cz) + dz);
  }
  out[lane] = x, out[lanes + lane] = y, out[2 * lanes + lane] = z;
}
