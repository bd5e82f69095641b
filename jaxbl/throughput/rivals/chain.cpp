// The workload by hand: SIMD over lanes, the loop over time innermost with a lane's state in registers, OpenMP over blocks
// of lanes. What this machine can do in practice.
#include "vectors.hpp"

struct Constants {
  double period, motor_inertia, motor_viscous, load_inertia, load_viscous, gear_ratio, stiffness, slope, share;
  double motor_error;  // velocity error of the motor's observer at t = 0
  double amplitude, frequency;
};

template <class V>
struct alignas(64) Sums {
  V first, both, second, motor_first, motor_second, load_first, load_second, motor_rate, load_rate;
};
constexpr int SUMS = 9;

template <class T, int U>
void run_block(const Constants& c, int steps, int start, int window, const T* torque, const T* noise, int lanes, int first,
               const T* const* given, T* const* out) {
  using V = stdx::native_simd<T>;
  constexpr int W = V::size();
  const T h = c.period, half = T(0.5) * h, ratio = c.gear_ratio, share = c.share, stiffness = c.stiffness;
  const T slope = T(0.5) * T(c.slope);
  const T motor_mass = T(c.motor_inertia) / h, motor_drag = T(0.5) * T(c.motor_viscous);
  const T load_mass = T(c.load_inertia) / h, load_drag = T(0.5) * T(c.load_viscous);
  const T motor_keep = (motor_mass - motor_drag) / (motor_mass + motor_drag), motor_gain = T(1) / (motor_mass + motor_drag);
  const T load_keep = (load_mass - load_drag) / (load_mass + load_drag), load_gain = T(1) / (load_mass + load_drag);
  const T motor_inverse = T(1) / T(c.motor_inertia), load_inverse = T(1) / T(c.load_inertia);

  V motor_alpha[U], motor_lambda[U], load_alpha[U], load_lambda[U], gap[U], motor_noise[U], load_noise[U];
  V motor[U], motor_rate[U], load[U], load_rate[U], motor_seen[U], motor_guess[U], load_seen[U], load_guess[U];
  V motor_control[U], load_control[U], twist_filtered[U], bend_filtered[U];
  Sums<V> total[U], error[U];
  for (int k = 0; k < U; ++k) {
    const int at = first + k * W;
    auto read = [&](int i) { return V(given[i] + at, stdx::element_aligned); };
    motor_alpha[k] = read(0), motor_lambda[k] = read(1), load_alpha[k] = read(2), load_lambda[k] = read(3);
    gap[k] = T(4) * read(4), motor_noise[k] = read(5), load_noise[k] = read(5) / ratio;
    motor[k] = motor_rate[k] = load[k] = load_rate[k] = V(0);
    motor_seen[k] = load_seen[k] = load_guess[k] = V(0), motor_guess[k] = V(T(-c.motor_error));
    motor_control[k] = load_control[k] = twist_filtered[k] = bend_filtered[k] = V(0);
    total[k] = error[k] = Sums<V>{};
  }
  for (int begin = 0; begin < steps; begin += 512) {
    // sums in two levels, the upper one compensated: what float32 needs over long runs
    Sums<V> recent[U] = {};
    const int end = begin + 512 < steps ? begin + 512 : steps;
    for (int i = begin; i < end; ++i) {
      const T u = torque[i], n0 = noise[2 * i], n1 = noise[2 * i + 1];
      const T counts = i >= start ? T(1) : T(0), inside = i >= window ? T(1) : T(0);
#pragma GCC unroll 8
      for (int k = 0; k < U; ++k) {
        const V motor_read = motor[k] + motor_noise[k] * n0, load_read = load[k] + load_noise[k] * n1;
        const V motor_before = motor_rate[k], load_before = load_rate[k];
        // plant: drift, kick, drift
        const V motor_middle = motor[k] + half * motor_rate[k], load_middle = load[k] + half * load_rate[k];
        const V z = motor_middle - ratio * load_middle;
        const V through = stiffness * (z - gap[k] * tanh_of(V(slope * z)));
        motor_rate[k] = motor_keep * motor_rate[k] + motor_gain * (u - through);
        load_rate[k] = load_keep * load_rate[k] + load_gain * (ratio * through);
        motor[k] = motor_middle + half * motor_rate[k];
        load[k] = load_middle + half * load_rate[k];
        // observers
        const V motor_miss = motor_read - motor_seen[k], load_miss = load_read - load_seen[k];
        const V motor_sign = sign_of(motor_miss), load_sign = sign_of(load_miss);
        const V motor_now = motor_alpha[k] * motor_sign, load_now = load_alpha[k] * load_sign;
        const V motor_was = motor_guess[k], load_was = load_guess[k];
        motor_seen[k] += h * (motor_was + motor_lambda[k] * motor_sign * stdx::sqrt(stdx::abs(motor_miss)));
        load_seen[k] += h * (load_was + load_lambda[k] * load_sign * stdx::sqrt(stdx::abs(load_miss)));
        motor_guess[k] += h * ((u - T(c.motor_viscous) * motor_was) * motor_inverse + motor_now);
        load_guess[k] += h * (load_now - T(c.load_viscous) * load_inverse * load_was);
        // equivalent control, and the torque that it stands for
        motor_control[k] += share * (motor_now - motor_control[k]);
        load_control[k] += share * (load_now - load_control[k]);
        const V motor_torque = T(-c.motor_inertia) * motor_control[k];
        const V load_torque = T(c.load_inertia / c.gear_ratio) * load_control[k];
        // identifiers, on regressors that passed the same low-pass
        const V seen = motor_read - ratio * load_read, bend = T(-4) * tanh_of(V(slope * seen));
        const V one = twist_filtered[k], two = bend_filtered[k];
        twist_filtered[k] += share * (seen - one);
        bend_filtered[k] += share * (bend - two);
        const V one_counted = counts * one, two_counted = counts * two;
        Sums<V>& sum = recent[k];
        sum.first += one_counted * one, sum.both += one_counted * two, sum.second += two_counted * two;
        sum.motor_first += one_counted * motor_torque, sum.motor_second += two_counted * motor_torque;
        sum.load_first += one_counted * load_torque, sum.load_second += two_counted * load_torque;
        const V motor_off = motor_before - motor_was, load_off = load_before - load_was;
        sum.motor_rate += inside * motor_off * motor_off, sum.load_rate += inside * load_off * load_off;
      }
    }
    for (int k = 0; k < U; ++k) {
      V *sum = &total[k].first, *lost = &error[k].first, *part = &recent[k].first;
      for (int j = 0; j < SUMS; ++j) {
        const V corrected = part[j] - lost[j], next = sum[j] + corrected;
        lost[j] = (next - sum[j]) - corrected;  // compiled without licence to reorder
        sum[j] = next;
      }
    }
  }
  for (int k = 0; k < U; ++k)
    for (int j = 0; j < SUMS; ++j) (&total[k].first)[j].copy_to(out[j] + first + k * W, stdx::element_aligned);
}

// Torque and unit noise of some samples, whole vectors of them.
template <class T>
void make_inputs(const Constants& c, std::uint32_t seed, int first, T* torque, T* noise) {
  make_noise(seed, first, noise);
  for (int i = 0; i < SAMPLES; ++i)
    torque[first + i] = T(c.amplitude) * std::sin(T(6.283185307179586 * c.frequency) * (T(first + i) * T(c.period)));
}

// `own`: torque and noise, of whole vectors of samples, are made here, from the seed.
template <class T, int U>
void run_all(const Constants& c, int steps, int start, int window, T* torque, T* noise, int lanes, const T* const* given,
             T* const* out, int threads, bool own, std::uint32_t seed) {
  constexpr int block = U * stdx::native_simd<T>::size();
#pragma omp parallel num_threads(threads)
  {
    if (own) {
#pragma omp for schedule(static)
      for (int first = 0; first < steps; first += SAMPLES) make_inputs(c, seed, first, torque, noise);
    }
#pragma omp for schedule(static)
    for (int first = 0; first < lanes; first += block)
      run_block<T, U>(c, steps, start, window, torque, noise, lanes, first, given, out);
  }
}

// Two vectors at a time: one's latency hides behind the other's (four are no faster).
#define ENTRY(NAME, T)                                                                                                \
  extern "C" void NAME(const Constants* c, int steps, int start, int window, T* torque, T* noise, int lanes,           \
                       const T* const* given, T* const* out, int threads, int own, std::uint32_t seed) {               \
    run_all<T, 2>(*c, steps, start, window, torque, noise, lanes, given, out, threads, own, seed);                     \
  }
ENTRY(chain_float32, float)
ENTRY(chain_float64, double)
