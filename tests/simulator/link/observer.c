/* An observer of a link, for test_c_header.py: torn messages, and calls without a link.
 *
 *   observer torn|stopped /NAME    the program is also the server's writer, which begins a message
 *                                  while the image of the message before it is copied
 *   observer unattached|left|quit /NAME    calls after a failed attach, a detach or a quit
 */
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static void begin_second_message(const void *to);

static void *watched_memcpy(void *to, const void *from, size_t count) {
    begin_second_message(to);
    return memcpy(to, from, count);
}

#define memcpy watched_memcpy
#include "driverview_link.h"
#undef memcpy

static struct drvlink link_;
static int stopped;
static uint32_t *sequence;

static void begin(uint64_t number) {
    enum { WORDS = sizeof(struct drvlink_state) / 8 };
    struct drvlink_state state;
    uint64_t words[WORDS];
    memset(&state, 0, sizeof state);
    state.number = number;
    memcpy(words, &state, sizeof words);
    words[WORDS - 1] = drvlink_checksum(words, WORDS);
    __atomic_store_n(sequence, *sequence | 1, __ATOMIC_RELEASE);
    memcpy(link_.memory + DRVLINK_STATE_OFFSET + 8, words + 1, sizeof words - 8);
    memset(link_.memory + DRVLINK_IMAGE_OFFSET, (int)number, link_.header.image_bytes);
}

static void end(void) {
    __atomic_store_n(sequence, *sequence + 1, __ATOMIC_RELEASE);
    syscall(SYS_futex, sequence, 1 /* FUTEX_WAKE */, INT_MAX, NULL, NULL, 0);
}

static void *end_later(void *unused) {
    drvlink_sleep(0.05);
    end();
    return unused;
}

static void begin_second_message(const void *to) {
    pthread_t thread;
    if (!link_.image || to != link_.image + link_.header.image_bytes / 16 * 8) return;
    if (*sequence != 2) return;
    begin(2);
    if (!stopped && !pthread_create(&thread, NULL, end_later, NULL)) pthread_detach(thread);
}

static void print(const char *call, int returned) {
    printf("%s: %d, %s\n", call, returned, link_.error);
    fflush(stdout);
}

static void observe(void) {
    sequence = (uint32_t *)(void *)(link_.memory + DRVLINK_STATE_OFFSET);
    link_.timeout_s = stopped ? 0.2 : 60.0;
    link_.image = calloc(1, link_.header.image_bytes);
    begin(1);
    end();
    print("latest", drvlink_latest(&link_));
    int same = 1;
    for (size_t i = 0; i < link_.header.image_bytes; i++)
        same = same && link_.image[i] == link_.state.number;
    printf("number %d, image %s\n", (int)link_.state.number, same ? "whole" : "torn");
    free(link_.image);
}

static void call_everything(void) {
    print("latest", drvlink_latest(&link_));
    print("step", drvlink_step(&link_, 0.0, 0.0, 0.0, 1));
    print("reset", drvlink_reset(&link_, 1));
    print("reset_at", drvlink_reset_at(&link_, 1, 0.0, 0.0, 0.0, 0.0));
    print("quit", drvlink_quit(&link_));
    drvlink_detach(&link_);
}

int main(int count, char **words) {
    if (count != 3) return 2;
    int failed = drvlink_attach(&link_, words[2], 180.0 * !!strcmp(words[1], "unattached"));
    if (failed != -!strcmp(words[1], "unattached")) return puts(link_.error), 1;
    stopped = !strcmp(words[1], "stopped");
    if (stopped || !strcmp(words[1], "torn")) return observe(), 0;
    if (!strcmp(words[1], "left")) drvlink_detach(&link_);
    if (!strcmp(words[1], "quit")) drvlink_quit(&link_);
    return call_everything(), 0;
}
