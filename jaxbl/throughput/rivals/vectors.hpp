// What the kernels share: elementary functions of vectors, and the encoders' noise.
#pragma once
#include <bit>
#include <cmath>
#include <cstdint>
#include <experimental/simd>

namespace stdx = std::experimental;

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

// e^y - 1 = m, y = 2 |x|: m / (m + 2), one division. The coefficients are those of jaxbl's own loop (elementary.py).
template <class V>
inline V tanh_of(V x) requires(sizeof(typename V::value_type) == 8) {
  const V y = 2.0 * stdx::min(stdx::abs(x), V(22.0)), shifter = V(6755399441055744.0);
  const V shifted = y * 1.4426950408889634 + shifter;  // 1.5 * 2^52: rounds, and leaves the integer in the low bits
  const V n = shifted - shifter;
  const V r = (y - n * 6.93145751953125e-1) - n * 1.42860682030941723212e-6;
  V p = V(2.5053924629252286e-08);
  for (double next : {2.7626042389919065e-07, 2.7557407082504333e-06, 2.480150526060296e-05, 0.00019841269719503187,
                      0.0013888888931578205, 0.008333333333389335, 0.0416666666665767, 0.1666666666666659,
                      0.5000000000000006})
    p = p * r + next;
  using Bits = stdx::rebind_simd_t<std::int64_t, V>;
  const V power = std::bit_cast<V>((std::bit_cast<Bits>(shifted) + Bits(1023)) << 52);
  const V m = (p * r * r + r) * power + (power - 1.0);
  return stdx::copysign(m / (m + 2.0), x);
}

template <class V>
inline V sign_of(V x) {
  V s = V(0);
  stdx::where(x > 0, s) = V(1);
  stdx::where(x < 0, s) = V(-1);
  return s;
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

// Unit noise of some samples, whole vectors of them, of the motor and the load: jaxbl's noise but for rounding.
template <class T>
inline void make_noise(std::uint32_t seed, int first, T* noise) {
  Words k0 = 0u, k1([first](auto i) { return std::uint32_t(first + int(i)); });
  threefry(0u, seed, k0, k1);
  Floats drawn[2];
#pragma GCC unroll 2
  for (int side = 0; side < 2; ++side) {
    Words a = 0u, b = std::uint32_t(side);
    threefry(k0, k1, a, b);
    drawn[side] = normal_of(a ^ b);
  }
  for (int i = 0; i < SAMPLES; ++i)
    noise[2 * (first + i)] = T(drawn[0][i]), noise[2 * (first + i) + 1] = T(drawn[1][i]);
}
