/* Smooth stop at 0 V for a command that ends in motion or is held away from its mean. */
#ifndef LANDING_H
#define LANDING_H

#include "target.h"

#include <math.h>

struct landing {
    double c[6], seconds; /* coefficients of the quintic, V, V/s, ...; duration */
};

static double within_span(double volts) { return fmax(-SPAN_V, fmin(SPAN_V, volts)); }

/* Return the command in V, `s` seconds after the start of the stop. */
static double landing_at(const struct landing *l, double s) {
    const double *c = l->c;
    return c[0] + s * (c[1] + s * (c[2] + s * (c[3] + s * (c[4] + s * c[5]))));
}

/* Compute the quintic from position x, velocity v, acceleration a (V, V/s, V/s2) to rest at 0 V in
 * T s. Return its peak acceleration in V/s2; `reach` receives its peak position in V. */
static double quintic(struct landing *l, double T, double x, double v, double a, double *reach) {
    double *c = l->c, peak = 0.0;
    c[0] = x, c[1] = v, c[2] = a / 2.0;
    c[3] = -(20.0 * x + 12.0 * v * T + 3.0 * a * T * T) / (2.0 * T * T * T);
    c[4] = (30.0 * x + 16.0 * v * T + 3.0 * a * T * T) / (2.0 * pow(T, 4));
    c[5] = -(12.0 * x + 6.0 * v * T + a * T * T) / (2.0 * pow(T, 5));
    l->seconds = T;
    *reach = 0.0;
    for (int k = 0; k <= 100; k++) {
        double s = T * k / 100.0;
        peak = fmax(peak, fabs(2 * c[2] + s * (6 * c[3] + s * (12 * c[4] + s * 20 * c[5]))));
        *reach = fmax(*reach, fabs(landing_at(l, s)));
    }
    return peak;
}

/* Choose, within the span, the shortest quintic from 0.5 s on whose acceleration stays below
 * max(0.5 m/s2, 1.05 |a|); if there is none, that of least peak acceleration; if none stays within
 * the span, the command stops abruptly at x and returns to 0 from there. */
static void land_from(struct landing *l, double x, double v, double a) {
    double gentle = fmax(0.5 / METRES_PER_VOLT, 1.05 * fabs(a)), least = INFINITY, best = 0.0;
    double reach, span = (1.0 + 1e-9) * fmax(fabs(x), SPAN_V);
    for (double T = 0.1; T < 72.0; T *= 1.2) {
        double peak = quintic(l, T, x, v, a, &reach);
        if (!(reach <= span)) continue;
        if (peak < least) least = peak, best = T;
        if (T >= 0.5 && peak <= gentle) {
            best = T;
            break;
        }
    }
    if (best > 0.0)
        quintic(l, best, x, v, a, &reach);
    else if (v != 0.0 || a != 0.0)
        land_from(l, x, 0.0, 0.0);
    else
        quintic(l, 60.0, x, 0.0, 0.0, &reach);
}

#endif
