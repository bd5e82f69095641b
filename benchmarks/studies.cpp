// Two of the package's studies by hand, in double precision, as chain.cpp does the benchmark's chain: several plant steps a
// sample, implicit observers, filter, identifiers, and every metric of the run. The plant is each lane's own, or one for all.
#include "vectors.hpp"

using V = stdx::native_simd<double>;
constexpr int W = V::size();

struct Study {
  double period, motor_inertia, motor_viscous, load_inertia, load_viscous, gear_ratio, stiffness, slope, share;
  double motor_error;  // velocity error of the motor's observer at t = 0
  double position_tolerance, velocity_tolerance;
  std::int64_t steps, substeps, block, start, window;  // samples: of a run, of a block of sums, first ones that count
};

// What a metric's carry is made of, in the order in which it is written.
struct alignas(64) Metrics {
  V last, position, velocity, torque, position_size, velocity_size, chatter, previous, perturbation, acceleration;
};
struct alignas(64) Sums {
  V first, both, second, motor_first, motor_second, load_first, load_second;
};
constexpr int METRICS = 10, SUMS = 7;

struct Observer {
  V seen, guess, reach, damping, square;

  void begin(V lambda, V alpha, double h, double velocity_error) {
    seen = V(0), guess = V(-velocity_error);
    reach = h * h * alpha, damping = h * lambda, square = damping * damping;
  }
  // Backward Euler of the correction; estimates and the switching term.
  template <class F>
  [[gnu::always_inline]] void step(V measured, double h, F acceleration, V& position, V& velocity, V& control) {
    const V innovation = measured - seen;
    const V sliding = stdx::max(-reach, stdx::min(reach, innovation)), beyond = innovation - sliding;
    const V half = beyond / stdx::max(damping + stdx::sqrt(square + 4.0 * stdx::abs(beyond)), V(2.2250738585072014e-308));
    control = sliding * (1.0 / (h * h));
    position = measured - 4.0 * half * stdx::abs(half);
    velocity = guess + h * control;
    const V predicted = acceleration(velocity + h * (control + 0.5 * acceleration(velocity)));
    seen = position + h * (velocity + 0.5 * h * predicted);
    guess = velocity + h * predicted;
  }
};

// One plant: lanes of it, or a number.
template <class X>
struct Plant {
  X motor, motor_rate, load, load_rate;
};

struct Kick {
  double half, ratio, stiffness, slope, motor_keep, motor_gain, load_keep, load_gain;

  explicit Kick(const Study& c) {
    const double h = c.period / double(c.substeps);
    const double motor_mass = c.motor_inertia / h, motor_drag = 0.5 * c.motor_viscous;
    const double load_mass = c.load_inertia / h, load_drag = 0.5 * c.load_viscous;
    half = 0.5 * h, ratio = c.gear_ratio, stiffness = c.stiffness, slope = 0.5 * c.slope;
    motor_keep = (motor_mass - motor_drag) / (motor_mass + motor_drag), motor_gain = 1.0 / (motor_mass + motor_drag);
    load_keep = (load_mass - load_drag) / (load_mass + load_drag), load_gain = 1.0 / (load_mass + load_drag);
  }
  template <class X>
  [[gnu::always_inline]] X transmitted(X z, X gap) const {
    if constexpr (std::is_same_v<X, double>)
      return stiffness * (z - gap * std::tanh(slope * z));
    else
      return stiffness * (z - gap * tanh_of(X(slope * z)));
  }
  template <class X>
  [[gnu::always_inline]] void step(Plant<X>& p, double u, X gap) const {
    const X motor = p.motor + half * p.motor_rate, load = p.load + half * p.load_rate;
    const X through = transmitted(X(motor - ratio * load), gap);
    p.motor_rate = motor_keep * p.motor_rate + motor_gain * (u - through);
    p.load_rate = load_keep * p.load_rate + load_gain * (ratio * through);
    p.motor = motor + half * p.motor_rate, p.load = load + half * p.load_rate;
  }
};

// What all lanes share of a sample where they share the plant.
struct Sample {
  double motor, motor_rate, load, load_rate, through, motor_acceleration, load_acceleration;
};

inline void settle(V* total, V* lost, V* recent, int count) {
  for (int j = 0; j < count; ++j) {
    const V corrected = recent[j] - lost[j], next = total[j] + corrected;
    lost[j] = (next - total[j]) - corrected;  // compiled without licence to reorder
    total[j] = next, recent[j] = V(0);
  }
}

template <bool OWN, int U>
void run_block(const Study& c, const double* torque, const double* noise, const Sample* samples, int first,
               const double* const* given, double* const* out) {
  const Kick kick(c);
  const double h = c.period, per = 1.0 / h, ratio = c.gear_ratio, share = c.share, slope = 0.5 * c.slope;
  const double motor_inverse = 1.0 / c.motor_inertia, motor_drag = c.motor_viscous / c.motor_inertia;
  const double load_drag = c.load_viscous / c.load_inertia, load_share = c.load_inertia / c.gear_ratio;
  Observer motor[U], load[U];
  Metrics motor_metrics[U], load_metrics[U];
  Sums total[U] = {}, error[U] = {}, recent[U] = {};
  V gap[U], motor_noise[U], load_noise[U], motor_filtered[U], load_filtered[U], twist_filtered[U], bend_filtered[U];
  Plant<V> plant[U];
  for (int k = 0; k < U; ++k) {
    auto read = [&](int i) { return V(given[i] + first + k * W, stdx::element_aligned); };
    motor[k].begin(read(1), read(0), h, c.motor_error), load[k].begin(read(3), read(2), h, 0.0);
    gap[k] = 4.0 * read(4), motor_noise[k] = read(5), load_noise[k] = read(5) / ratio;
    motor_metrics[k] = load_metrics[k] = Metrics{V(-1)};
    motor_filtered[k] = load_filtered[k] = twist_filtered[k] = bend_filtered[k] = V(0);
    plant[k] = {V(0), V(0), V(0), V(0)};
  }
  for (std::int64_t begin = 0; begin < c.steps; begin += c.block) {
    const std::int64_t end = begin + c.block < c.steps ? begin + c.block : c.steps;
    for (std::int64_t i = begin; i < end; ++i) {
      const double u = torque[i], n0 = noise[2 * i], n1 = noise[2 * i + 1], time = double(i) * h;
      const double counts = i >= c.start ? 1.0 : 0.0, inside = i >= c.window ? 1.0 : 0.0;
      Plant<V> now[U];
      V through[U];
      if constexpr (OWN) {
#pragma GCC unroll 8
        for (int k = 0; k < U; ++k)
          now[k] = plant[k], through[k] = kick.transmitted(V(now[k].motor - ratio * now[k].load), gap[k]);
        for (std::int64_t j = 0; j < c.substeps; ++j)
#pragma GCC unroll 8
          for (int k = 0; k < U; ++k) kick.step(plant[k], u, gap[k]);
      }
#pragma GCC unroll 8
      for (int k = 0; k < U; ++k) {
        V motor_acceleration, load_acceleration;
        if constexpr (OWN) {
          motor_acceleration = (plant[k].motor_rate - now[k].motor_rate) * per;
          load_acceleration = (plant[k].load_rate - now[k].load_rate) * per;
        } else {
          const Sample& s = samples[i];
          now[k] = {V(s.motor), V(s.motor_rate), V(s.load), V(s.load_rate)}, through[k] = V(s.through);
          motor_acceleration = V(s.motor_acceleration), load_acceleration = V(s.load_acceleration);
        }
        const V motor_read = now[k].motor + motor_noise[k] * n0, load_read = now[k].load + load_noise[k] * n1;
        auto of_motor = [&](V v) __attribute__((always_inline)) { return u * motor_inverse - motor_drag * v; };
        auto of_load = [&](V v) __attribute__((always_inline)) { return -load_drag * v; };
        V motor_at, motor_speed, motor_control, load_at, load_speed, load_control;
        motor[k].step(motor_read, h, of_motor, motor_at, motor_speed, motor_control);
        load[k].step(load_read, h, of_load, load_at, load_speed, load_control);
        motor_filtered[k] += share * (motor_control - motor_filtered[k]);
        load_filtered[k] += share * (load_control - load_filtered[k]);
        const V motor_torque = -c.motor_inertia * motor_filtered[k], load_torque = load_share * load_filtered[k];
        // identifiers, on regressors that passed the same low-pass, one sample late
        const V seen = motor_read - ratio * load_read, bend = -4.0 * tanh_of(V(slope * seen));
        const V one = twist_filtered[k], two = bend_filtered[k], one_counted = counts * one, two_counted = counts * two;
        twist_filtered[k] += share * (seen - one);
        bend_filtered[k] += share * (bend - two);
        Sums& sum = recent[k];
        sum.first += one_counted * one, sum.both += one_counted * two, sum.second += two_counted * two;
        sum.motor_first += one_counted * motor_torque, sum.motor_second += two_counted * motor_torque;
        sum.load_first += one_counted * load_torque, sum.load_second += two_counted * load_torque;
        auto measure = [&](Metrics& m, V at, V rate, V estimate, V speed, V torque_estimate, V acceleration, V expected,
                           double gear) __attribute__((always_inline)) {
          const V position = at - estimate, velocity = rate - speed, lost = through[k] - torque_estimate;
          const auto outside = !(stdx::abs(position) * gear <= c.position_tolerance) ||
                               !(stdx::abs(velocity) * gear <= c.velocity_tolerance);
          stdx::where(outside, m.last) = V(time);
          m.position += inside * position * position, m.velocity += inside * velocity * velocity;
          m.torque += inside * lost * lost;
          m.position_size += inside * at * at, m.velocity_size += inside * rate * rate;
          const V change = velocity - m.previous;
          m.chatter += inside * change * change, m.previous = velocity;
          m.perturbation = stdx::max(m.perturbation, stdx::abs(acceleration - expected));
          m.acceleration = stdx::max(m.acceleration, stdx::abs(acceleration));
        };
        measure(motor_metrics[k], now[k].motor, now[k].motor_rate, motor_at, motor_speed, motor_torque, motor_acceleration,
                of_motor(motor_speed), 1.0);
        measure(load_metrics[k], now[k].load, now[k].load_rate, load_at, load_speed, load_torque, load_acceleration,
                of_load(load_speed), ratio);
      }
    }
    for (int k = 0; k < U; ++k) settle(&total[k].first, &error[k].first, &recent[k].first, SUMS);
  }
  for (int k = 0; k < U; ++k) {
    auto write = [&](const V* values, int count, int at) {
      for (int j = 0; j < count; ++j) values[j].copy_to(out[at + j] + first + k * W, stdx::element_aligned);
    };
    write(&motor_metrics[k].last, METRICS, 0), write(&load_metrics[k].last, METRICS, METRICS);
    write(&total[k].first, SUMS, 2 * METRICS);
  }
}

template <int U>
void run_all(const Study& c, const double* torque, double* noise, Sample* samples, int lanes, int own, std::int64_t seed,
             const double* const* given, double* const* out, int threads) {
#pragma omp parallel num_threads(threads)
  {
    if (seed >= 0) {
#pragma omp for schedule(static) nowait
      for (std::int64_t first = 0; first < c.steps; first += SAMPLES) make_noise(std::uint32_t(seed), int(first), noise);
    }
    if (!own) {
#pragma omp single
      {
        const Kick kick(c);
        const double gap = 4.0 * given[4][0];
        Plant<double> plant = {};
        for (std::int64_t i = 0; i < c.steps; ++i) {
          const Plant<double> now = plant;
          for (std::int64_t j = 0; j < c.substeps; ++j) kick.step(plant, torque[i], gap);
          samples[i] = {now.motor, now.motor_rate, now.load, now.load_rate,
                        kick.transmitted(now.motor - c.gear_ratio * now.load, gap),
                        (plant.motor_rate - now.motor_rate) / c.period, (plant.load_rate - now.load_rate) / c.period};
        }
      }
    }
#pragma omp barrier
#pragma omp for schedule(dynamic)
    for (int first = 0; first < lanes; first += U * W) {
      if (own)
        run_block<true, U>(c, torque, noise, samples, first, given, out);
      else
        run_block<false, U>(c, torque, noise, samples, first, given, out);
    }
  }
}

// Lanes with plants of their own or one for all, `vectors` of them at a time: one's latency hides behind another's. Noise is
// given where the seed is negative, else made here.
extern "C" void study(const Study* c, const double* torque, double* noise, void* samples, int lanes, int own,
                      std::int64_t seed, const double* const* given, double* const* out, int threads, int vectors) {
  auto run = vectors == 1 ? run_all<1> : vectors == 2 ? run_all<2> : run_all<4>;
  run(*c, torque, noise, static_cast<Sample*>(samples), lanes, own, seed, given, out, threads);
}
