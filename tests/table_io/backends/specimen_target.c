/* Target with a specimen, for tests: the demonstration target, its ideal table replaced by a servo
 * of second order that bears a mass on a rubber bearing between two bumpers that relax. Equations and
 * integrator are its own; parameters are given in SI, so that they can differ from the twin's.
 *
 *     cc -O2 target.c specimen_target.c -lm -o target
 *     ./target HOST PORT, with MASS_KG, STIFFNESS, DAMPING, GAP_M in the environment
 */
#define _POSIX_C_SOURCE 200809L
#include "target.h"

#define read_inputs read_ideal_inputs
#define write_output write_ideal_output
#include "target_demo.c"
#undef read_inputs
#undef write_output

#include <math.h>
#include <stdlib.h>

enum { Y, VY, X, VX, RIGHT, LEFT, STATES };
#define SUBSTEPS 20
#define TABLE_KG 2000.0
#define SERVO_RAD_S 195.25 /* of a double pole: -3 dB at 20 Hz */
#define BUMPER_N_M 510e3
#define BUMPER_N_S_M 900.0

static double state[STATES], command_m, table_acc, mass_acc, right_n, left_n;
static double mass_kg, stiffness, damping, half_gap_m;

static double read_setting(const char *name, double otherwise) {
    const char *text = getenv(name);
    return text ? atof(text) : otherwise;
}

static int touched[2]; /* right, left; fixed during a step of the integrator */

/* Force of a bumper of compression d whose face closes at `speed` with the mass, if touched. */
static double press(int side, double d, double speed, double *rate) {
    *rate = touched[side] ? speed : -BUMPER_N_M / BUMPER_N_S_M * d;
    return touched[side] ? BUMPER_N_M * d + BUMPER_N_S_M * speed : 0.0;
}

static void find_rates(const double *s, double *rate) {
    double u = s[X] - s[Y], v = s[VX] - s[VY];
    right_n = press(0, s[RIGHT], v, &rate[RIGHT]);
    left_n = press(1, s[LEFT], -v, &rate[LEFT]);
    double on_table = stiffness * u + damping * v + right_n - left_n;
    mass_acc = -on_table / mass_kg;
    table_acc = SERVO_RAD_S * (SERVO_RAD_S * (command_m - s[Y]) - 2.0 * s[VY]) + on_table / TABLE_KG;
    rate[Y] = s[VY], rate[VY] = table_acc, rate[X] = s[VX], rate[VX] = mass_acc;
}

static void advance(double h) {
    double k[4][STATES], at[STATES];
    for (int stage = 0; stage < 4; stage++) {
        double share = stage == 0 ? 0.0 : stage == 3 ? 1.0 : 0.5;
        for (int n = 0; n < STATES; n++)
            at[n] = state[n] + (stage ? share * h * k[stage - 1][n] : 0.0);
        find_rates(at, k[stage]);
    }
    for (int n = 0; n < STATES; n++)
        state[n] += h / 6.0 * (k[0][n] + 2.0 * (k[1][n] + k[2][n]) + k[3][n]);
    find_rates(state, k[0]);
    for (int side = 0; side < 2; side++) {
        double u = state[X] - state[Y], *d = &state[side ? LEFT : RIGHT];
        double reach = (side ? -u : u) - half_gap_m;
        if (touched[side])
            *d = reach, touched[side] = (side ? left_n : right_n) > 0.0;
        else
            touched[side] = reach > *d;
    }
}

/* The output stage interpolates: the acceleration of a servo would show the steps of a hold. */
static double command_before_m, command_next_m;

void write_output(double volts) {
    command_before_m = command_next_m, command_next_m = volts * METRES_PER_VOLT;
}

int read_inputs(double volts[CHANNELS]) {
    if (mass_kg == 0.0) {
        mass_kg = read_setting("MASS_KG", 550.0), stiffness = read_setting("STIFFNESS", 36e3);
        damping = read_setting("DAMPING", 1100.0), half_gap_m = 0.5 * read_setting("GAP_M", 4e-3);
    }
    for (int step = 0; step < SUBSTEPS; step++) {
        double share = (step + 0.5) / SUBSTEPS;
        command_m = command_before_m + share * (command_next_m - command_before_m);
        advance(1.0 / (SUBSTEPS * target_rate_hz()));
    }
    command_m = command_next_m;
    double rates[STATES], g = 9.80665;
    find_rates(state, rates);
    volts[0] = command_m / METRES_PER_VOLT;
    volts[1] = state[Y] * 1e3 / 7.5 + noise(5e-4);
    volts[2] = table_acc / g * 5.0 + noise(2.5e-3);
    volts[3] = state[X] * 1e3 / 10.0 + noise(5e-4);
    volts[4] = mass_acc / g * 2.0 + noise(1e-3);
    for (int cell = 0; cell < 2; cell++) {
        volts[5 + cell] = 0.5e-3 * right_n + noise(1e-3);
        volts[7 + cell] = 0.5e-3 * left_n + noise(1e-3);
    }
    sample++;
    return !(lost_from < sample && sample <= lost_to);
}
