/* Faults of the file system and of the clock for one program, loaded before all other libraries
 * (LD_PRELOAD): what Python, shutil and the C++ of OpenVINO and Arrow write passes through here.
 *
 * Every call that changes something below `folder` is counted. With the call number `at` the
 * program is killed in the middle of it, the call fails, or the clock jumps. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/time.h>
#include <sys/uio.h>
#include <time.h>
#include <unistd.h>

enum kind { NOTHING, COUNT, KILL, FULL, FULL_ONCE, READ_ONLY, CLOCK };
enum need { SPACE, NONE }; /* of the disk: what removes or renames works on a full one */
enum outcome { GO_ON, HALF, FAIL };

struct plan {
    long count, at, kind, jump_s;
    char folder[4096];
};

static struct plan *shared; /* with the processes that are forked */
static _Thread_local char place[8192];

__attribute__((constructor)) static void begin(void)
{
    shared = mmap(NULL, sizeof *shared, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
}

struct plan *fault_plan(void) { return shared; }

#define REAL(name) \
    static __typeof__(name) *real; \
    if (!real) real = (__typeof__(name) *)dlsym(RTLD_NEXT, #name)

static const char *of_file(int file)
{
    char link[64];
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t size = readlink(link, place, sizeof place - 1);
    place[size < 0 ? 0 : size] = 0;
    return place;
}

static const char *of_path(int folder, const char *path)
{
    if (path[0] == '/') return path;
    if (folder == AT_FDCWD) {
        if (!getcwd(place, sizeof place / 2)) return path;
    } else {
        of_file(folder);
    }
    size_t used = strlen(place);
    snprintf(place + used, sizeof place - used, "/%s", path);
    return place;
}

static int is_below(const char *path)
{
    size_t size = strlen(shared->folder);
    return strncmp(path, shared->folder, size) == 0 && (path[size] == '/' || !path[size]);
}

/* What becomes of a call that changes `path`. */
static enum outcome due(const char *path, enum need need)
{
    if (!shared || shared->kind == NOTHING || !is_below(path)) return GO_ON;
    long number = __atomic_add_fetch(&shared->count, 1, __ATOMIC_SEQ_CST);
    if (number < shared->at) return GO_ON;
    switch (shared->kind) {
    case KILL:
        return number == shared->at ? HALF : GO_ON;
    case READ_ONLY:
        errno = EROFS;
        return FAIL;
    case FULL_ONCE:
        if (number > shared->at) return GO_ON; /* fallthrough */
    case FULL:
        if (need == NONE) return GO_ON;
        errno = ENOSPC;
        return number == shared->at ? HALF : FAIL;
    default:
        return GO_ON;
    }
}

/* For a call that cannot be done by half: whether it fails. */
static int fails(const char *path, enum need need)
{
    enum outcome outcome = due(path, need);
    if (outcome == HALF && shared->kind == KILL) raise(SIGKILL);
    return outcome != GO_ON;
}

/* After a write that was done by half. */
static ssize_t half(ssize_t written)
{
    if (shared->kind == KILL) raise(SIGKILL);
    if (written > 0) return written;
    errno = ENOSPC;
    return -1;
}

static int changes(int flags) { return (flags & O_ACCMODE) != O_RDONLY || (flags & O_CREAT); }

/* A disk without space still opens the files that exist. */
static enum need need_of(const char *path)
{
    return faccessat(AT_FDCWD, path, F_OK, AT_EACCESS) == 0 ? NONE : SPACE;
}

#define OPEN(name, folder, declared, passed) \
    int name declared \
    { \
        REAL(name); \
        mode_t mode = 0; \
        if (flags & O_CREAT) { \
            va_list more; \
            va_start(more, flags); \
            mode = va_arg(more, mode_t); \
            va_end(more); \
        } \
        if (changes(flags)) { \
            const char *found = of_path(folder, path); \
            if (fails(found, need_of(found))) return -1; \
        } \
        return real passed; \
    }
OPEN(open, AT_FDCWD, (const char *path, int flags, ...), (path, flags, mode))
OPEN(open64, AT_FDCWD, (const char *path, int flags, ...), (path, flags, mode))
OPEN(openat, at, (int at, const char *path, int flags, ...), (at, path, flags, mode))
OPEN(openat64, at, (int at, const char *path, int flags, ...), (at, path, flags, mode))

ssize_t write(int file, const void *data, size_t size)
{
    REAL(write);
    enum outcome outcome = due(of_file(file), SPACE);
    if (outcome == FAIL) return -1;
    return outcome == HALF ? half(real(file, data, size / 2)) : real(file, data, size);
}

ssize_t writev(int file, const struct iovec *parts, int count)
{
    REAL(writev);
    enum outcome outcome = due(of_file(file), SPACE);
    if (outcome == FAIL) return -1;
    return outcome == HALF ? half(real(file, parts, count / 2)) : real(file, parts, count);
}

#define AT_OFFSET(name, offset_t) \
    ssize_t name(int file, const void *data, size_t size, offset_t offset) \
    { \
        REAL(name); \
        enum outcome outcome = due(of_file(file), SPACE); \
        if (outcome == FAIL) return -1; \
        return outcome == HALF ? half(real(file, data, size / 2, offset)) \
                               : real(file, data, size, offset); \
    }
AT_OFFSET(pwrite, off_t)
AT_OFFSET(pwrite64, off64_t)

#define SEND(name, offset_t) \
    ssize_t name(int to, int from, offset_t *offset, size_t size) \
    { \
        REAL(name); \
        enum outcome outcome = due(of_file(to), SPACE); \
        if (outcome == FAIL) return -1; \
        struct stat about; \
        if (outcome == HALF && fstat(from, &about) == 0 && (size_t)about.st_size < size) \
            size = about.st_size; \
        return outcome == HALF ? half(real(to, from, offset, size / 2)) \
                               : real(to, from, offset, size); \
    }
SEND(sendfile, off_t)
SEND(sendfile64, off64_t)

#define ON_FILE(name, declared, passed, need) \
    int name declared \
    { \
        REAL(name); \
        return fails(of_file(file), need) ? -1 : real passed; \
    }
ON_FILE(ftruncate, (int file, off_t size), (file, size), NONE)
ON_FILE(ftruncate64, (int file, off64_t size), (file, size), NONE)

/* No power cut is played here: waiting for the disk would only take time. */
int fsync(int file) { return fails(of_file(file), SPACE) ? -1 : 0; }
int fdatasync(int file) { return fsync(file); }

#define ON_PATH(name, folder, declared, passed, need) \
    int name declared \
    { \
        REAL(name); \
        return fails(of_path(folder, path), need) ? -1 : real passed; \
    }
ON_PATH(mkdir, AT_FDCWD, (const char *path, mode_t mode), (path, mode), SPACE)
ON_PATH(mkdirat, at, (int at, const char *path, mode_t mode), (at, path, mode), SPACE)
ON_PATH(symlink, AT_FDCWD, (const char *to, const char *path), (to, path), SPACE)
ON_PATH(rmdir, AT_FDCWD, (const char *path), (path), NONE)
ON_PATH(unlink, AT_FDCWD, (const char *path), (path), NONE)
ON_PATH(unlinkat, at, (int at, const char *path, int flags), (at, path, flags), NONE)
ON_PATH(rename, AT_FDCWD, (const char *from, const char *path), (from, path), NONE)
ON_PATH(renameat, at, (int of, const char *from, int at, const char *path), (of, from, at, path), NONE)

/* The clock of the calendar; time that only passes (CLOCK_MONOTONIC) never jumps. */
static long jumped(void)
{
    int now = shared && shared->kind == CLOCK && shared->count >= shared->at;
    return now ? shared->jump_s : 0;
}

int clock_gettime(clockid_t clock, struct timespec *time)
{
    REAL(clock_gettime);
    int done = real(clock, time);
    if (clock == CLOCK_REALTIME) time->tv_sec += jumped();
    return done;
}

int gettimeofday(struct timeval *restrict time, void *restrict zone)
{
    REAL(gettimeofday);
    int done = real(time, zone);
    time->tv_sec += jumped();
    return done;
}

time_t time(time_t *found)
{
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (found) *found = now.tv_sec;
    return now.tv_sec;
}
