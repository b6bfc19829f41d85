/* ---- how to use it ------------------------------------------------------------------------------
 *
 * struct drvlink link;
 * if (drvlink_attach(&link, "/driverview", 30.0) || drvlink_reset(&link, 1)) puts(link.error);
 * while (!drvlink_step(&link, steer, throttle, 0.0, 1)) { ... link.state.to_middle ... }
 * drvlink_detach(&link);
 *
 * Every function returns 0, or -1 with a message in link.error; drvlink_latest also returns 1.
 * After a refusal (link.state.error is not 0) the link stays usable and the state of the car is
 * unchanged; after any other error the link is unusable. `link.image`, if set to a buffer of
 * link.header.image_bytes bytes, receives the image of every message. One thread at a time; no
 * fork() without exec(): it would share the lock.
 */
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#define DRVLINK_SPINS 30000
#define DRVLINK_SLICE_S 0.05

struct drvlink {
    struct drvlink_header header;   /* a copy */
    struct drvlink_command command; /* the last one sent, or being filled in */
    struct drvlink_state state;     /* the newest message */
    uint8_t *image;                 /* NULL, or where to copy pictures to */
    double timeout_s;               /* for an answer; 2 s unless you change it */
    char error[512];
    /* Internal: */
    int fd, torn; /* torn: `image` is a copy during which the server wrote */
    uint8_t *memory;
    char name[256];
};

static inline double drvlink_now(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static inline void drvlink_sleep(double seconds) {
    struct timespec time = {(time_t)seconds, (long)(1e9 * (seconds - (double)(time_t)seconds))};
    nanosleep(&time, NULL);
}

/* F_OFD_GETLK: 1 if another end holds the byte. F_OFD_SETLK: 1 if it is ours now. */
static inline int drvlink_lock(int fd, int how, int end) {
    struct flock lock;
    memset(&lock, 0, sizeof lock);
    lock.l_type = F_WRLCK;
    lock.l_whence = SEEK_SET;
    lock.l_start = end;
    lock.l_len = 1;
    int failed = fcntl(fd, how, &lock);
    return how == F_OFD_GETLK ? !failed && lock.l_type != F_UNLCK : !failed;
}

static inline int drvlink_server_lives(const struct drvlink *link) {
    return drvlink_lock(link->fd, F_OFD_GETLK, 0);
}

/* Removes the segment if its server is dead and the name still leads to it. */
static inline void drvlink_remove_if_dead(struct drvlink *link) {
    struct stat ours, named;
    int fd = drvlink_lock(link->fd, F_OFD_SETLK, 0) ? shm_open(link->name, O_RDONLY, 0) : -1;
    if (fd < 0) return;
    if (!fstat(link->fd, &ours) && !fstat(fd, &named) && ours.st_ino == named.st_ino)
        shm_unlink(link->name);
    close(fd);
}

static inline uint64_t drvlink_checksum(const uint64_t *words, size_t count) {
    uint64_t value = 0xcbf29ce484222325ull; /* FNV-1a */
    for (size_t i = 1; i + 1 < count; i++) value = (value ^ words[i]) * 0x100000001b3ull;
    return value;
}

/* Copies `count` words that another process may be writing. */
static inline void drvlink_copy(void *to, const uint8_t *from, size_t count) {
    for (size_t i = 0; i < count; i++) {
        uint64_t word = __atomic_load_n((const uint64_t *)(const void *)from + i, __ATOMIC_RELAXED);
        memcpy((uint8_t *)to + 8 * i, &word, 8);
    }
}

/* The newest message into link->state, if it is whole and newer: 1, else 0; -1 if it is damaged.
 * After 0, link->image is the image of link->state unless link->torn. */
static inline int drvlink_read(struct drvlink *link) {
    const uint8_t *block = link->memory + DRVLINK_STATE_OFFSET;
    const uint32_t *sequence = (const uint32_t *)(const void *)block;
    enum { WORDS = sizeof(struct drvlink_state) / 8 };
    uint64_t words[WORDS];
    for (int i = 0; i < 100; i++) {
        uint32_t begun = __atomic_load_n(sequence, __ATOMIC_ACQUIRE);
        if (begun == link->state.sequence) return 0;
        if (begun & 1) continue;
        drvlink_copy(words, block, WORDS);
        if (link->image)
            drvlink_copy(link->image, link->memory + DRVLINK_IMAGE_OFFSET,
                         link->header.image_bytes / 8);
        __atomic_thread_fence(__ATOMIC_ACQUIRE);
        link->torn = __atomic_load_n(sequence, __ATOMIC_RELAXED) != begun;
        if (link->torn) continue;
        memcpy(&link->state, words, sizeof words);
        link->state.sequence = begun;
        if (drvlink_checksum(words, WORDS) == link->state.check) return 1;
        snprintf(link->error, sizeof link->error, "a message of %s is damaged", link->name);
        return -1;
    }
    return 0;
}

/* Waits for a message: spins briefly, then sleeps for at most DRVLINK_SLICE_S. */
static inline void drvlink_wait(struct drvlink *link) {
    uint32_t *sequence = (uint32_t *)(void *)(link->memory + DRVLINK_STATE_OFFSET), now = 0;
    for (int i = 0; i < DRVLINK_SPINS; i++) {
        now = __atomic_load_n(sequence, __ATOMIC_ACQUIRE);
        if (now != link->state.sequence && !(now & 1)) return;
    }
    struct timespec limit = {0, (long)(1e9 * DRVLINK_SLICE_S)};
    syscall(SYS_futex, sequence, 0 /* FUTEX_WAIT */, now, &limit, NULL, 0);
}

/* As drvlink_read; -1 also if there is no message and the server has ended. */
static inline int drvlink_poll(struct drvlink *link) {
    int running = drvlink_server_lives(link), came = drvlink_read(link);
    if (came || running) return came;
    int closed = ((struct drvlink_header *)(void *)link->memory)->phase == DRVLINK_PHASE_CLOSED;
    snprintf(link->error, sizeof link->error,
             "the server of %s (process %llu) has %s; start it again", link->name,
             (unsigned long long)link->header.engine_pid, closed ? "ended" : "died");
    return -1;
}

/* 0 if the link is attached, else -1 with a message: that of the failed attach, if there is one. */
static inline int drvlink_attached(struct drvlink *link) {
    if (link->memory) return 0;
    if (!link->error[0])
        snprintf(link->error, sizeof link->error, "the link %s is closed; attach again",
                 link->name);
    return -1;
}

static inline int drvlink_timed_out(struct drvlink *link) {
    snprintf(link->error, sizeof link->error,
             "the server of %s (process %llu) is running, but has not answered within %g s",
             link->name, (unsigned long long)link->header.engine_pid, link->timeout_s);
    return -1;
}

/* The newest message, without a request. 1 if there was a new one, 0 if not, -1 on an error.
 * Waits for at most timeout_s, and only while the server is writing a message. */
static inline int drvlink_latest(struct drvlink *link) {
    if (drvlink_attached(link)) return -1;
    for (double until = drvlink_now() + link->timeout_s;;) {
        int came = drvlink_poll(link);
        if (came || !link->torn) return came;
        if (drvlink_now() > until) return drvlink_timed_out(link);
        drvlink_wait(link);
    }
}

static inline void drvlink_send(struct drvlink *link) {
    struct drvlink_command *command = &link->command;
    uint64_t words[sizeof *command / 8];
    size_t count = sizeof words / 8;
    uint64_t *shared = (uint64_t *)(void *)(link->memory + DRVLINK_COMMAND_OFFSET);
    uint32_t *sequence = (uint32_t *)(void *)shared;
    command->number++;
    command->seen = link->state.number;
    memcpy(words, command, sizeof words);
    command->check = words[count - 1] = drvlink_checksum(words, count);
    uint32_t begun = __atomic_load_n(sequence, __ATOMIC_RELAXED) | 1;
    __atomic_store_n(sequence, begun, __ATOMIC_RELAXED);
    __atomic_thread_fence(__ATOMIC_RELEASE);
    for (size_t i = 1; i < count; i++) __atomic_store_n(shared + i, words[i], __ATOMIC_RELAXED);
    __atomic_store_n(sequence, begun + 1, __ATOMIC_RELEASE);
    syscall(SYS_futex, sequence, 1 /* FUTEX_WAKE */, INT_MAX, NULL, NULL, 0);
}

/* Sends link->command and waits for the message that answers it. */
static inline int drvlink_ask(struct drvlink *link) {
    if (drvlink_attached(link)) return -1;
    drvlink_send(link);
    for (double until = drvlink_now() + link->timeout_s; drvlink_now() < until;) {
        drvlink_wait(link);
        int came = drvlink_read(link);
        if (!came) came = drvlink_poll(link);
        if (came < 0) return -1;
        if (link->state.session != link->command.session) continue;
        if (link->state.answers != link->command.number) continue;
        snprintf(link->error, sizeof link->error, "%.255s", link->state.error_text);
        return link->state.error ? -1 : 0;
    }
    return drvlink_timed_out(link);
}

static inline int drvlink_reset_at(struct drvlink *link, int64_t seed, double s, double to_middle,
                                   double angle, double speed) {
    link->command.request = DRVLINK_REQUEST_RESET;
    link->command.seed = seed;
    link->command.start_s = s;
    link->command.start_to_middle = to_middle;
    link->command.start_angle = angle;
    link->command.start_speed = speed;
    return drvlink_ask(link);
}

/* 25 m before the line, at rest; a negative seed lets the server choose one. */
static inline int drvlink_reset(struct drvlink *link, int64_t seed) {
    return drvlink_reset_at(link, seed, NAN, 0.0, 0.0, 0.0);
}

static inline int drvlink_step(struct drvlink *link, double steer, double throttle, double brake,
                               int gear) {
    link->command.request = DRVLINK_REQUEST_STEP;
    link->command.steer = steer;
    link->command.throttle = throttle;
    link->command.brake = brake;
    link->command.gear = gear;
    return drvlink_ask(link);
}

static inline void drvlink_close(struct drvlink *link) {
    if (link->memory) {
        munmap(link->memory, link->header.segment_size);
        drvlink_remove_if_dead(link);
    }
    if (link->fd >= 0) close(link->fd);
    link->memory = NULL;
    link->fd = -1;
}

/* Disconnects; the server waits for its next client. */
static inline void drvlink_detach(struct drvlink *link) {
    link->command.request = DRVLINK_REQUEST_LEAVE;
    if (link->memory && drvlink_server_lives(link)) drvlink_ask(link);
    drvlink_close(link);
}

/* Ends the server. */
static inline int drvlink_quit(struct drvlink *link) {
    link->command.request = DRVLINK_REQUEST_QUIT;
    int failed = drvlink_ask(link);
    drvlink_close(link);
    return failed;
}

/* 0 if this program understands the segment of `size` bytes, else -1. */
static inline int drvlink_check(struct drvlink *link, size_t size) {
    const struct drvlink_header *theirs = &link->header;
    size_t room = sizeof link->error;
    ssize_t got = pread(link->fd, &link->header, sizeof link->header, 0);
    if (got < 40 || memcmp(theirs->magic, DRVLINK_MAGIC, sizeof theirs->magic))
        return snprintf(link->error, room, "%s is no driverview link", link->name), -1;
    if (theirs->byte_order == __builtin_bswap32(DRVLINK_BYTE_ORDER))
        return snprintf(link->error, room, "%s has the other byte order", link->name), -1;
    if (theirs->version != DRVLINK_VERSION || theirs->layout_hash != DRVLINK_LAYOUT_HASH)
        return snprintf(link->error, room,
                        "the server of %s writes layout %u (%016llx), this program was compiled "
                        "for %u (%016llx): compile it with the header of `simulator link --header`",
                        link->name, theirs->version, (unsigned long long)theirs->layout_hash,
                        DRVLINK_VERSION, (unsigned long long)DRVLINK_LAYOUT_HASH), -1;
    if (theirs->segment_size != size || size != DRVLINK_IMAGE_OFFSET + (size_t)theirs->image_bytes)
        return snprintf(link->error, room, "the segment %s has %zu bytes, its header says %llu",
                        link->name, size, (unsigned long long)theirs->segment_size), -1;
    return 0;
}

/* 0, -1, or 1 if there is no server (yet). */
static inline int drvlink_open(struct drvlink *link) {
    struct stat about;
    size_t room = sizeof link->error;
    link->fd = shm_open(link->name, O_RDWR, 0);
    if (link->fd < 0 || fstat(link->fd, &about)) {
        snprintf(link->error, room, "no link %s: %s", link->name, strerror(errno));
        return errno == ENOENT ? 1 : -1;
    }
    if (drvlink_check(link, (size_t)about.st_size)) return -1;
    if (!drvlink_server_lives(link)) {
        drvlink_remove_if_dead(link);
        return snprintf(link->error, room, "the server of %s has died", link->name), 1;
    }
    if (!drvlink_lock(link->fd, F_OFD_SETLK, 1))
        return snprintf(link->error, room, "%s has a client already", link->name), -1;
    void *memory = mmap(NULL, (size_t)about.st_size, PROT_READ | PROT_WRITE, MAP_SHARED, link->fd, 0);
    if (memory == MAP_FAILED)
        return snprintf(link->error, room, "cannot map %s: %s", link->name, strerror(errno)), -1;
    link->memory = (uint8_t *)memory;
    return 0;
}

/* Becomes the client of the server of that name; waits up to wait_s for it to be there. */
static inline int drvlink_attach(struct drvlink *link, const char *name, double wait_s) {
    double until = drvlink_now() + wait_s;
    memset(link, 0, sizeof *link);
    link->timeout_s = 2.0;
    link->fd = -1;
    if (name[0] != '/' || strchr(name + 1, '/') || strlen(name) >= sizeof link->name - 5) {
        snprintf(link->error, sizeof link->error, "no name of a link: %.200s; say /driverview", name);
        return -1;
    }
    snprintf(link->name, sizeof link->name, "%s", name);
    int failed = drvlink_open(link);
    while (failed > 0 && drvlink_now() < until) {
        drvlink_close(link);
        drvlink_sleep(0.02);
        failed = drvlink_open(link);
    }
    if (failed) return drvlink_close(link), -1;
    drvlink_copy(&link->command, link->memory + DRVLINK_COMMAND_OFFSET, sizeof link->command / 8);
    uint64_t session = link->command.session + 1;
    memset(&link->command, 0, sizeof link->command);
    link->command.session = session;
    link->command.client_pid = (uint32_t)getpid();
    link->command.gear = 1;
    return 0;
}
