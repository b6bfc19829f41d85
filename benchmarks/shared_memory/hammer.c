/* hammer.c: the C side of benchmarks/link.py.
 *
 *   hammer drive NAME           steps for ever, over and over; ends with the link
 *   hammer time NAME STEPS      one line: microseconds of every step
 *   hammer write NAME           commands as fast as it can; all words of one are its number
 *   hammer read NAME COUNT S    takes COUNT messages, for at most S seconds, and says how many
 *                                    were whole, torn and damaged
 *   hammer racy NAME COUNT S    the same without looking at the sequence: the control
 */
#include <stdio.h>
#include <stdlib.h>

#include "driverview_link.h"

enum { STATE_WORDS = sizeof(struct drvlink_state) / 8 };

static int step(struct drvlink *link) {
    if (link->state.ended && drvlink_reset(link, 1)) return -1;
    return drvlink_step(link, 0.0, 0.2, 0.0, 1);
}

static int drive(struct drvlink *link) {
    if (drvlink_reset(link, 1)) return -1;
    puts("driving");
    fflush(stdout);
    while (!step(link)) {}
    return -1;
}

static int measure(struct drvlink *link, long steps) {
    if (drvlink_reset(link, 1)) return -1;
    for (long i = 0; i < steps; i++) {
        double began = drvlink_now();
        if (step(link)) return -1;
        printf("%.3f ", 1e6 * (drvlink_now() - began));
    }
    puts("");
    return 0;
}

static int flood(struct drvlink *link) {
    uint64_t words[sizeof link->command / 8];
    for (uint64_t number = 1;; number++) {
        for (size_t i = 0; i < sizeof words / 8; i++) words[i] = number;
        memcpy(&link->command, words, sizeof words);
        link->command.number = number - 1; /* drvlink_send counts it up */
        link->state.number = number;       /* and says that this is the message seen */
        drvlink_send(link);
        if (number % 4096 == 0 && !drvlink_server_lives(link)) return 0;
    }
}

/* Whether all words of the message, and of its picture, are the same number. */
static int is_whole(const struct drvlink *link, uint64_t *words) {
    memcpy(words, &link->state, sizeof link->state);
    for (int i = 2; i < STATE_WORDS - 1; i++)
        if (words[i] != words[1]) return 0;
    for (size_t i = 0; i < link->header.image_bytes; i += 8)
        if (memcmp(link->image + i, words + 1, 8)) return 0;
    return 1;
}

static int count(struct drvlink *link, long goal, double seconds, int careful) {
    uint64_t words[STATE_WORDS];
    long whole = 0, torn = 0, damaged = 0;
    double began = drvlink_now();
    for (long i = 0; whole + torn < goal; i++) {
        if (i % 4096 == 0 && drvlink_now() - began > seconds) break;
        if (careful) {
            int came = drvlink_read(link);
            damaged += came < 0;
            if (came <= 0) continue;
        } else {
            uint64_t before = link->state.number;
            drvlink_copy(&link->state, link->memory + DRVLINK_STATE_OFFSET, STATE_WORDS);
            drvlink_copy(link->image, link->memory + DRVLINK_IMAGE_OFFSET,
                         link->header.image_bytes / 8);
            if (link->state.number == before) continue;
        }
        if (is_whole(link, words))
            whole++;
        else
            torn++;
    }
    printf("{\"messages\": %ld, \"torn\": %ld, \"damaged\": %ld, \"seconds\": %.3f}\n",
           whole + torn, torn, damaged, drvlink_now() - began);
    return 0;
}

int main(int number, char **arguments) {
    struct drvlink link;
    const char *task = number > 2 ? arguments[1] : "";
    if (number < 3 || drvlink_attach(&link, arguments[2], 180.0)) {
        fprintf(stderr, "error: %s\n", number < 3 ? "see the top of hammer.c" : link.error);
        return 1;
    }
    int failed = -1;
    if (link.header.image_bytes) link.image = malloc(link.header.image_bytes);
    if (!strcmp(task, "drive")) failed = drive(&link);
    if (!strcmp(task, "time")) failed = measure(&link, atol(arguments[3]));
    if (!strcmp(task, "write")) failed = flood(&link);
    if (!strcmp(task, "read")) failed = count(&link, atol(arguments[3]), atof(arguments[4]), 1);
    if (!strcmp(task, "racy")) failed = count(&link, atol(arguments[3]), atof(arguments[4]), 0);
    if (failed) fprintf(stderr, "error: %s\n", link.error);
    drvlink_close(&link); /* leave is not taken: there may be nobody who would answer */
    free(link.image);
    return failed ? 1 : 0;
}
