/* lap.c: drives one lap over the link with state feedback steering, and prints the result.
 *
 *   simulator link --track oval --name /driverview &
 *   simulator link --header driverview_link.h
 *   gcc -std=c11 -O2 -D_GNU_SOURCE -o lap lap.c -lm
 *   ./lap /driverview [SEED [LOG]]
 *
 * The control law is that of TORCS's reference laps: front-wheel angle (rad)
 * = -(1.0 d + 0.1 (vy + vx sin th) + 2.0 th + 0.1 yr), with d the metres left of the track's centre
 * and th = yaw - tangent, counter-clockwise: the link's `angle` with the other sign. Throttle 0.2
 * and gear 1 are held. LOG receives every state message, as raw bytes.
 *
 * The drive begins at rest, 25 m before the line; the lap is from the first crossing to the second.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "driverview_link.h"

static const double THROTTLE = 0.2;
static const int GEAR = 1;
static const double WAIT_S = 180.0;

struct result {
    unsigned long steps;
    double crossed_s, finished_s, largest_d;
};

static double steer(const struct drvlink_state *now, double lock) {
    double th = -now->angle;
    double wheel = -(now->to_middle + 0.1 * (now->vy + now->vx * sin(th)) + 2.0 * th +
                     0.1 * now->yaw_rate);
    return fmin(fmax(wheel / lock, -1.0), 1.0);
}

static void record(FILE *log, const struct drvlink_state *now) {
    if (log) fwrite(now, sizeof *now, 1, log);
}

/* Drives until the second crossing of the line; -1 if the link fails or the car leaves the road. */
static int drive(struct drvlink *link, FILE *log, struct result *result) {
    const struct drvlink_state *now = &link->state;
    record(log, now);
    while (now->lap < 2) {
        int lap = now->lap;
        if (drvlink_step(link, steer(now, link->header.steering_lock), THROTTLE, 0.0, GEAR))
            return -1;
        record(log, now);
        result->steps++;
        if (now->ended) {
            snprintf(link->error, sizeof link->error, "the car went off at s = %.1f m", now->s);
            return -1;
        }
        if (now->lap > lap) *(lap ? &result->finished_s : &result->crossed_s) = now->time_s;
        if (now->lap == 1) result->largest_d = fmax(result->largest_d, fabs(now->to_middle));
    }
    return 0;
}

int main(int count, char **arguments) {
    struct drvlink link;
    struct result result = {0, 0.0, 0.0, 0.0};
    if (count < 2) {
        fprintf(stderr, "usage: %s /NAME [SEED [LOG]]\n", arguments[0]);
        return 2;
    }
    FILE *log = count > 3 ? fopen(arguments[3], "wb") : NULL;
    if (count > 3 && !log) {
        perror(arguments[3]);
        return 1;
    }
    double began = drvlink_now();
    int failed = drvlink_attach(&link, arguments[1], WAIT_S);
    if (!failed) {
        printf("%s: %.1f m, %u lane(s), %u Hz\n", link.header.track, link.header.track_length,
               link.header.lanes, link.header.frequency_hz);
        began = drvlink_now();
        failed = drvlink_reset(&link, count > 2 ? atoll(arguments[2]) : -1) ||
                 drive(&link, log, &result);
    }
    double seconds = drvlink_now() - began;
    if (failed) fprintf(stderr, "error: %s\n", link.error);
    drvlink_detach(&link);
    if (log && fclose(log)) {
        perror(arguments[3]);
        return 1;
    }
    if (!failed)
        printf("lap time %.2f s, largest |d| %.6f m, %lu steps, %.0f steps a second\n",
               result.finished_s - result.crossed_s, result.largest_d, result.steps,
               (double)result.steps / seconds);
    return failed ? 1 : 0;
}
