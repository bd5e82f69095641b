// The workload by hand: SIMD over lanes, the loop over time innermost with a lane's state in registers, OpenMP over blocks
// of lanes. What this machine can do in practice.
#include <bit>
#include <cmath>
#include <cstdint>
#include <experimental/simd>

namespace stdx = std::experimental;

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

// Rational approximation of float accuracy (a few units in the last place), as vector libraries and XLA have it.
template <class V>
inline V tanh_of(V x) requires(sizeof(typename V::value_type) == 4) {
  x = stdx::max(V(-7.90531110763549805f), stdx::min(V(7.90531110763549805f), x));
  const V z = x * x;
  V p = V(-2.76076847742355e-16f);
  p = p * z + 2.00018790482477e-13f;
  p = p * z + -8.60467152213735e-11f;
  p = p * z + 5.12229709037114e-08f;
  p = p * z + 1.48572235717979e-05f;
  p = p * z + 6.37261928875436e-04f;
  p = p * z + 4.89352455891786e-03f;
  V q = V(1.19825839466702e-06f);
  q = q * z + 1.18534705686654e-04f;
  q = q * z + 2.26843463243900e-03f;
  q = q * z + 4.89352518554385e-03f;
  return x * p / q;
}

// S. L. Moshier's Cephes: a rational function near zero, 1 - 2 / (exp(2 |x|) + 1) beyond.
template <class V>
inline V tanh_of(V x) requires(sizeof(typename V::value_type) == 8) {
  const V a = stdx::min(stdx::abs(x), V(22.0)), z = a * a;
  const V p = (V(-9.64399179425052238628e-1) * z - 9.92877231001918586564e1) * z - 1.61468768441708447952e3;
  const V q = ((z + 1.12811678491632931402e2) * z + 2.23548839060100448583e3) * z + 4.84406305325125486048e3;
  const V near = a + a * z * p / q;
  const V y = 2.0 * a, shifter = V(6755399441055744.0);  // 1.5 * 2^52: rounds, and leaves the integer in the low bits
  const V shifted = y * 1.4426950408889634 + shifter;
  const V n = shifted - shifter;
  const V r = (y - n * 6.93145751953125e-1) - n * 1.42860682030941723212e-6, s = r * r;
  const V up = r * ((V(1.26177193074810590878e-4) * s + 3.02994407707441961300e-2) * s + 9.99999999999999999910e-1);
  const V down = ((V(3.00198505138664455042e-6) * s + 2.52448340349684104192e-3) * s + 2.27265548208155028766e-1) * s + 2.0;
  using Bits = stdx::rebind_simd_t<std::int64_t, V>;
  const V power = std::bit_cast<V>((std::bit_cast<Bits>(shifted) + Bits(1023)) << 52);
  const V e = (1.0 + 2.0 * up / (down - up)) * power;
  V far = 1.0 - 2.0 / (e + 1.0);
  stdx::where(a < 0.625, far) = near;
  return stdx::copysign(far, x);
}

template <class V>
inline V sign_of(V x) {
  V s = V(0);
  stdx::where(x > 0, s) = V(1);
  stdx::where(x < 0, s) = V(-1);
  return s;
}

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

using Floats = stdx::native_simd<float>;
using Words = stdx::rebind_simd_t<std::uint32_t, Floats>;
constexpr int SAMPLES = Floats::size();

// Threefry-2x32 of 20 rounds, as JAX's generator has it (Salmon et al., 2011).
inline void threefry(Words k0, Words k1, Words& a, Words& b) {
  constexpr int turns[2][4] = {{13, 15, 26, 6}, {17, 29, 16, 24}};
  const Words keys[3] = {k0, k1, k0 ^ k1 ^ 0x1BD11BDAu};
  a += keys[0], b += keys[1];
#pragma GCC unroll 5
  for (int i = 0; i < 5; ++i) {
#pragma GCC unroll 4
    for (int j = 0; j < 4; ++j) {
      const int turn = turns[i % 2][j];
      a += b, b = ((b << turn) | (b >> (32 - turn))) ^ a;
    }
    a += keys[(i + 1) % 3], b += keys[(i + 2) % 3] + std::uint32_t(i + 1);
  }
}

// Cephes' logf, for numbers above the smallest normal one.
inline Floats log_of(Floats x) {
  const Words bits = std::bit_cast<Words>(x);
  Floats e = stdx::static_simd_cast<Floats>(std::bit_cast<stdx::rebind_simd_t<std::int32_t, Floats>>(bits >> 23)) - 126.0f;
  Floats m = std::bit_cast<Floats>((bits & 0x007FFFFFu) | 0x3F000000u);
  const auto low = m < 0.707106781186547524f;
  stdx::where(low, e) = e - 1.0f;
  stdx::where(low, m) = m + m;
  m -= 1.0f;
  const Floats z = m * m;
  Floats p = Floats(7.0376836292e-2f);
  for (float next : {-1.1514610310e-1f, 1.1676998740e-1f, -1.2420140846e-1f, 1.4249322787e-1f, -1.6668057665e-1f,
                     2.0000714765e-1f, -2.4999993993e-1f, 3.3333331174e-1f})
    p = p * m + next;
  return e * 0.693359375f + (e * -2.12194440e-4f + (m * z * p - 0.5f * z) + m);
}

// Normal numbers of random bits: JAX's way to uniform ones, and the inverse of erf by M. Giles (2010) that XLA has, too.
inline Floats normal_of(Words bits) {
  const Floats share = std::bit_cast<Floats>((bits >> 9) | 0x3F800000u) - 1.0f;
  const Floats x = stdx::max(Floats(-0.99999994f), share * 1.99999994f - 0.99999994f);
  const Floats w = -log_of((1.0f - x) * (1.0f + x)), near = w - 2.5f, far = stdx::sqrt(w) - 3.0f;
  Floats p = Floats(2.81022636e-08f), q = Floats(-0.000200214257f);
  for (float next : {3.43273939e-07f, -3.5233877e-06f, -4.39150654e-06f, 0.00021858087f, -0.00125372503f, -0.00417768164f,
                     0.246640727f, 1.50140941f})
    p = p * near + next;
  for (float next : {0.000100950558f, 0.00134934322f, -0.00367342844f, 0.00573950773f, -0.0076224613f, 0.00943887047f,
                     1.00167406f, 2.83297682f})
    q = q * far + next;
  stdx::where(w >= 5.0f, p) = q;
  return 1.41421356f * (p * x);
}

// Torque and unit noise of some samples, whole vectors of them: jaxbl's noise but for rounding.
template <class T>
void make_inputs(const Constants& c, std::uint32_t seed, int first, T* torque, T* noise) {
  Words k0 = 0u, k1([first](auto i) { return std::uint32_t(first + int(i)); });
  threefry(0u, seed, k0, k1);
  Floats drawn[2];
#pragma GCC unroll 2
  for (int side = 0; side < 2; ++side) {
    Words a = 0u, b = std::uint32_t(side);
    threefry(k0, k1, a, b);
    drawn[side] = normal_of(a ^ b);
  }
  for (int i = 0; i < SAMPLES; ++i) {
    noise[2 * (first + i)] = T(drawn[0][i]), noise[2 * (first + i) + 1] = T(drawn[1][i]);
    torque[first + i] = T(c.amplitude) * std::sin(T(6.283185307179586 * c.frequency) * (T(first + i) * T(c.period)));
  }
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
