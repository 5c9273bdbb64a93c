/* Double pendulums in Cartesian coordinates, by hand: what `mj.solve_ensemble` is compared with.
 *
 * The same method as `mj.Projected(dfx.Tsit5(), constraint)` with `dfx.PIDController(rtol, atol)`: links of
 * length 1, masses of its own for each pendulum, the accelerations from the 2 x 2 system for the tensions in
 * closed form; states corrected before the last stage, positions, then velocities, by two simplified Newton
 * iterations each with one factorization, along the inverse masses; no error below the correction; the first step
 * as in `_solve/first_step.py`.
 *
 *   gcc -O3 -march=native -shared -fPIC double_pendulum.c -lm             one pendulum after the other
 *   gcc -O3 -march=native -DLANES=8 -shared -fPIC double_pendulum.c -lm   eight, each with steps of its own,
 *                                                                         one that has ended makes room
 */
#include <math.h>
#include <stdlib.h>

#ifdef LANES
typedef double number __attribute__((vector_size(8 * LANES)));
typedef long long mask __attribute__((vector_size(8 * LANES)));
#define LANE(x, i) ((x)[i])
static inline number choose(mask m, number a, number b) {
  return (number)((m & (mask)a) | (~m & (mask)b));
}
#else
#define LANES 1
typedef double number;
typedef int mask;
#define LANE(x, i) (x)
static inline number choose(mask m, number a, number b) { return m ? a : b; }
#endif

enum { SIZE = 8, STAGES = 7, MOST_STEPS = 4096 };
static const double GRAVITY = 9.81, ROUNDING = 2.220446049250313e-16;

/* Tsitouras, Comput. Math. Appl. 62 (2011) 770-775. */
static const double A[STAGES - 1][STAGES - 1] = {
    {0.161},
    {-0.008480655492356989, 0.335480655492357},
    {2.8971530571054935, -6.359448489975075, 4.3622954328695815},
    {5.325864828439257, -11.748883564062828, 7.4955393428898365, -0.09249506636175525},
    {5.86145544294642, -12.92096931784711, 8.159367898576159, -0.071584973281401,
     -0.028269050394068383},
    {0.09646076681806523, 0.01, 0.4798896504144996, 1.379008574103742, -3.290069515436081,
     2.324710524099774}};
static const double ERROR[STAGES] = {
    0.0017800110522257773, 0.0008164344596567463, -0.007880878010261994, 0.1447110071732629,
    -0.5823571654525552,   0.45808210592918686,   -0.015151515151515152};

/* The two rods, and the inverse of the matrix of their tensions. */
typedef struct {
  number x, y, dx, dy, i1, i2, b11, b12, b22;
} rods;

static inline rods rods_of(const number q[4], number i1, number i2) {
  rods r = {q[0], q[1], q[2] - q[0], q[3] - q[1], i1, i2, i1, i1, i1};
  number a11 = (r.x * r.x + r.y * r.y) * i1, a12 = -(r.x * r.dx + r.y * r.dy) * i1;
  number a22 = (r.dx * r.dx + r.dy * r.dy) * (i1 + i2), d = 1 / (a11 * a22 - a12 * a12);
  r.b11 = a22 * d, r.b12 = -a12 * d, r.b22 = a11 * d;
  return r;
}

/* to[] -= M^-1 J^T A^-1 c */
static inline void pull(const rods *r, number c1, number c2, number to[4]) {
  number l1 = r->b11 * c1 + r->b12 * c2, l2 = r->b12 * c1 + r->b22 * c2;
  to[0] -= (r->x * l1 - r->dx * l2) * r->i1, to[1] -= (r->y * l1 - r->dy * l2) * r->i1;
  to[2] -= r->dx * l2 * r->i2, to[3] -= r->dy * l2 * r->i2;
}

static inline void field(const number y[SIZE], number i1, number i2, number f[SIZE]) {
  rods r = rods_of(y, i1, i2);
  const number *v = y + 4;
  number du = v[2] - v[0], dv = v[3] - v[1], zero = v[0] - v[0];
  for (int i = 0; i < 4; i++) f[i] = v[i];
  f[4] = f[6] = zero, f[5] = f[7] = zero - GRAVITY;
  pull(&r, v[0] * v[0] + v[1] * v[1] - GRAVITY * r.y, du * du + dv * dv, f + 4);
}

static inline void project(number y[SIZE], number i1, number i2) {
  rods r = rods_of(y, i1, i2);
  number *v = y + 4;
  for (int k = 0; k < 2; k++) {
    number dx = y[2] - y[0], dy = y[3] - y[1];
    pull(&r, (y[0] * y[0] + y[1] * y[1] - 1) / 2, (dx * dx + dy * dy - 1) / 2, y);
  }
  number dx = y[2] - y[0], dy = y[3] - y[1];
  for (int k = 0; k < 2; k++)
    pull(&r, y[0] * v[0] + y[1] * v[1], dx * (v[2] - v[0]) + dy * (v[3] - v[1]), v);
}

static inline number larger(number a, number b) { return choose(a > b, a, b); }
static inline number absolute(number a) { return larger(a, -a); }

/* Squared, in the norm of the controller. */
static inline number level(const number x[SIZE], const number y[SIZE], const number z[SIZE],
                           double tolerance) {
  number sum = x[0] - x[0];
  for (int i = 0; i < SIZE; i++) {
    number s = x[i] / (tolerance + tolerance * larger(absolute(y[i]), absolute(z[i])));
    sum += s * s;
  }
  return sum / SIZE;
}

/* One step of size h from y with derivative k[0]: the corrected state, and its error, squared. */
static inline number step(const number y[SIZE], number h, number i1, number i2, double tolerance,
                          number k[STAGES][SIZE], number to[SIZE]) {
  number raw[SIZE];
  for (int s = 1; s < STAGES; s++) {
    for (int i = 0; i < SIZE; i++) {
      number sum = A[s - 1][0] * k[0][i];
      for (int j = 1; j < s; j++) sum += A[s - 1][j] * k[j][i];
      to[i] = y[i] + h * sum;
    }
    if (s == STAGES - 1) {
      for (int i = 0; i < SIZE; i++) raw[i] = to[i];
      project(to, i1, i2);
    }
    field(to, i1, i2, k[s]);
  }
  number error[SIZE];
  for (int i = 0; i < SIZE; i++) {
    number sum = ERROR[0] * k[0][i];
    for (int j = 1; j < STAGES; j++) sum += ERROR[j] * k[j][i];
    error[i] = larger(absolute(h * sum), absolute(to[i] - raw[i]));
  }
  return level(error, y, to, tolerance);
}

/* Sizes of the first steps, and the derivatives there. */
static inline number begin(const number y[SIZE], number i1, number i2, double t1, double tolerance,
                           number f[SIZE]) {
  number there[SIZE], change[SIZE], h = y[0] - y[0];
  field(y, i1, i2, f);
  number n0 = level(y, y, y, tolerance), n1 = level(f, y, y, tolerance);
  for (int l = 0; l < LANES; l++) LANE(h, l) = 0.01 * sqrt(LANE(n0, l) / LANE(n1, l));
  for (int i = 0; i < SIZE; i++) there[i] = y[i] + h * f[i];
  field(there, i1, i2, change);
  for (int i = 0; i < SIZE; i++) change[i] -= f[i];
  number n2 = level(change, y, y, tolerance);
  for (int l = 0; l < LANES; l++) {
    double d = sqrt(LANE(n1, l)), h0 = LANE(h, l), rate = sqrt(LANE(n2, l)) / h0 / d;
    double h1 = pow(0.01 / d, 1.0 / 6) * pow(rate, -5.0 / 6);
    LANE(h, l) = fmin(fmin(100 * h0, h1), t1);
  }
  return h;
}

/* From t = 0 to t1. `starts` and `ends` are (n, 8), `masses` is (n, 2), `steps` is (n). Nonzero if one
 * took too many steps. */
int solve(int n, const double *starts, const double *masses, double t1, double tolerance,
          double *ends, long long *steps) {
  double *derivatives = malloc(sizeof(double) * SIZE * n), *first = malloc(sizeof(double) * n);
  number y[SIZE] = {0}, k[STAGES][SIZE] = {0}, to[SIZE], i1 = {0}, i2 = {0};
  for (int b = 0; b < n; b += LANES) {
    for (int l = 0; l < LANES; l++) {
      int j = b + l < n ? b + l : n - 1;
      for (int i = 0; i < SIZE; i++) LANE(y[i], l) = starts[SIZE * j + i];
      LANE(i1, l) = 1 / masses[2 * j], LANE(i2, l) = 1 / masses[2 * j + 1];
    }
    number h = begin(y, i1, i2, t1, tolerance, k[0]);
    for (int l = 0; l < LANES && b + l < n; l++) {
      first[b + l] = LANE(h, l);
      for (int i = 0; i < SIZE; i++) derivatives[SIZE * (b + l) + i] = LANE(k[0][i], l);
    }
  }
  double t[LANES], end[LANES], last = t1 - 50 * ROUNDING * t1;
  int own[LANES], next = 0, ended = 0, failed = 0;
  long long taken[LANES] = {0};
  for (int l = 0; l < LANES; l++) own[l] = -1, t[l] = t1, end[l] = t1;
  for (;;) {
    for (int l = 0; l < LANES; l++) {
      if (t[l] < t1 && taken[l] < MOST_STEPS) continue;
      if (own[l] >= 0) {
        for (int i = 0; i < SIZE; i++) ends[SIZE * own[l] + i] = LANE(y[i], l);
        failed |= t[l] < t1, steps[own[l]] = taken[l], ended++;
        own[l] = -1, t[l] = end[l] = t1;
      }
      if (next == n) continue;
      own[l] = next++, t[l] = 0, end[l] = first[own[l]], taken[l] = 0;
      for (int i = 0; i < SIZE; i++) {
        LANE(y[i], l) = starts[SIZE * own[l] + i];
        LANE(k[0][i], l) = derivatives[SIZE * own[l] + i];
      }
      LANE(i1, l) = 1 / masses[2 * own[l]], LANE(i2, l) = 1 / masses[2 * own[l] + 1];
    }
    if (ended == n) break;
    number h = i1;
    for (int l = 0; l < LANES; l++) LANE(h, l) = end[l] - t[l];
    number error = step(y, h, i1, i2, tolerance, k, to);
    mask kept = error < 1;
    for (int i = 0; i < SIZE; i++) {
      y[i] = choose(kept, to[i], y[i]);
      k[0][i] = choose(kept, k[STAGES - 1][i], k[0][i]);
    }
    for (int l = 0; l < LANES; l++) {
      if (own[l] < 0) continue;
      int keep = LANE(error, l) < 1;
      double factor = 0.9 * pow(LANE(error, l), -0.1);
      factor = keep ? fmin(fmax(factor, 1), 10) : fmin(fmax(factor, 0.2), 0.9);
      if (keep) t[l] = end[l];
      end[l] = t[l] + factor * LANE(h, l);
      if (end[l] > last) end[l] = keep ? t1 : t[l] + (t1 - t[l]) / 2;
      taken[l]++;
    }
  }
  free(derivatives), free(first);
  return failed;
}
