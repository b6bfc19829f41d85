/* A client of the perception service in plain C: POSIX sockets, no library, one connection kept.
 *
 *     cc -o features examples/features.c && ./features 127.0.0.1 8000 image.jpg ...
 *
 * Prints a line an image: the distances to the markings of the lane (m, left negative), the angle
 * (rad, positive when the car points to the right) and the heading class. A service that is too
 * busy answers 503 and says when to ask again; that is obeyed for GIVE_UP_S. With a token in
 * $DRIVERVIEW_TOKEN it is sent. Exit code 1 when an image got no answer.
 */
#define _POSIX_C_SOURCE 200809L

#include <errno.h>
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

#define BLANKS " \t\n\v\f\r"

enum { MAX_IMAGE = 4 << 20, MAX_ANSWER = 64 << 10, WAIT_S = 5, GIVE_UP_S = 10 };

struct answer {
    int status;             /* HTTP's; 0: the connection broke */
    double retry_after_ms;  /* < 0: not said */
    int keep;               /* the connection stays open */
    char *body;             /* JSON, ends in 0; points into `bytes` */
    char bytes[MAX_ANSWER + 1];
};

/* A connection to the first address of `host` that answers; -1: none does, -2: there is no such host. */
static int dial_host(const char *host, const char *port)
{
    struct addrinfo hints = {.ai_socktype = SOCK_STREAM}, *found = NULL;
    if (getaddrinfo(host, port, &hints, &found) != 0)
        return -2;
    struct timeval wait = {.tv_sec = WAIT_S};
    int connection = -1, yes = 1;
    for (struct addrinfo *at = found; at != NULL && connection < 0; at = at->ai_next) {
        connection = socket(at->ai_family, at->ai_socktype, at->ai_protocol);
        if (connection < 0)
            continue; /* a family that this kernel lacks */
        setsockopt(connection, SOL_SOCKET, SO_RCVTIMEO, &wait, sizeof wait);
        setsockopt(connection, SOL_SOCKET, SO_SNDTIMEO, &wait, sizeof wait); /* of connect, too */
        setsockopt(connection, IPPROTO_TCP, TCP_NODELAY, &yes, sizeof yes);
        if (connect(connection, at->ai_addr, at->ai_addrlen) != 0) {
            close(connection);
            connection = -1;
        }
    }
    freeaddrinfo(found);
    return connection;
}

/* "localhost" is both loopback addresses, whichever of them /etc/hosts names. */
static int dial(const char *host, const char *port)
{
    const char *const names[] = {host, "127.0.0.1", "::1"};
    const int count = strcasecmp(host, "localhost") == 0 ? 3 : 1;
    int connection = -2;
    for (int k = 0; k < count && connection < 0; k++) {
        int dialled = dial_host(names[k], port);
        connection = dialled == -2 ? connection : dialled;
    }
    if (connection == -2) {
        fprintf(stderr, "%s: there is no such host\n", host);
        exit(2);
    }
    return connection;
}

static int send_all(int connection, const char *bytes, size_t length)
{
    while (length > 0) {
        ssize_t sent = send(connection, bytes, length, MSG_NOSIGNAL);
        if (sent < 0 && errno == EINTR)
            continue;
        if (sent <= 0)
            return -1;
        bytes += sent;
        length -= (size_t)sent;
    }
    return 0;
}

/* The value of a header in the head of an answer, NULL where there is none. */
static const char *header(const char *head, const char *name)
{
    size_t length = strlen(name);
    for (const char *line = strstr(head, "\r\n"); line != NULL; line = strstr(line, "\r\n")) {
        line += 2;
        if (strncasecmp(line, name, length) == 0 && line[length] == ':')
            return line + length + 1 + strspn(line + length + 1, " \t");
    }
    return NULL;
}

/* The number after "name": in JSON from `from` on; `otherwise` for null, or where there is none. */
static double number(const char *from, const char *name, double otherwise)
{
    char key[64];
    snprintf(key, sizeof key, "\"%s\":", name);
    const char *found = from == NULL ? NULL : strstr(from, key);
    if (found == NULL)
        return otherwise;
    char *end;
    double value = strtod(found + strlen(key), &end);
    return end == found + strlen(key) ? otherwise : value;
}

static void receive(int connection, struct answer *answer)
{
    size_t have = 0, need = MAX_ANSWER;
    answer->status = 0;
    answer->body = NULL;
    while (have < need) {
        ssize_t got = recv(connection, answer->bytes + have, need - have, 0);
        if (got < 0 && errno == EINTR)
            continue;
        if (got <= 0)
            return;
        have += (size_t)got;
        answer->bytes[have] = 0;
        char *end = answer->body == NULL ? strstr(answer->bytes, "\r\n\r\n") : NULL;
        if (end != NULL) {
            *end = 0; /* the head and the body are two strings from here on */
            answer->body = end + 4;
            const char *length = header(answer->bytes, "Content-Length");
            need = (size_t)(answer->body - answer->bytes);
            unsigned long body = length == NULL ? 0 : strtoul(length, NULL, 10);
            if (body > MAX_ANSWER - need)
                return;
            need += body;
        }
    }
    if (answer->body == NULL || sscanf(answer->bytes, "HTTP/1.1 %d", &answer->status) != 1)
        return;
    const char *after = header(answer->bytes, "Retry-After"), *kept = header(answer->bytes, "Connection");
    answer->retry_after_ms = after == NULL ? -1 : 1e3 * strtod(after, NULL);
    if (answer->status != 200) /* the body knows it finer than the header, in whole seconds */
        answer->retry_after_ms = number(answer->body, "retry_after_ms", answer->retry_after_ms);
    answer->keep = kept == NULL || strncasecmp(kept, "close", 5) != 0;
}

static void ask(int connection, const char *host, const char *image, size_t length, struct answer *answer)
{
    const char *set = getenv("DRIVERVIEW_TOKEN");
    const char *token = set ? set + strspn(set, BLANKS) : "";
    size_t token_length = strlen(token); /* without the blanks around it, like a token in a file */
    while (token_length > 0 && strchr(BLANKS, token[token_length - 1]))
        token_length--;
    const int png = length > 4 && memcmp(image, "\x89PNG", 4) == 0;
    const int ipv6 = strchr(host, ':') != NULL; /* in brackets, without its zone */
    char head[1024];
    int size = snprintf(head, sizeof head,
                        "POST /features HTTP/1.1\r\nHost: %s%.*s%s\r\nContent-Type: image/%s\r\n"
                        "Accept: application/json\r\nContent-Length: %zu\r\n%s%.*s%s\r\n",
                        ipv6 ? "[" : "", (int)(ipv6 ? strcspn(host, "%") : strlen(host)), host,
                        ipv6 ? "]" : "", png ? "png" : "jpeg", length,
                        token_length ? "Authorization: Bearer " : "", (int)token_length, token,
                        token_length ? "\r\n" : "");
    answer->status = 0;
    if (size < 0 || (size_t)size >= sizeof head) {
        fprintf(stderr, "the host's name or the token is too long\n");
        exit(2);
    }
    /* Also when not all could be sent: the service may have said why before it cut the connection. */
    if (send_all(connection, head, (size_t)size) == 0)
        send_all(connection, image, length);
    receive(connection, answer);
}

static double now_s(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static void pause_ms(double ms)
{
    struct timespec left = {.tv_sec = (time_t)(ms / 1e3)};
    left.tv_nsec = (long)(1e6 * (ms - 1e3 * (double)left.tv_sec));
    while (nanosleep(&left, &left) != 0 && errno == EINTR)
        ;
}

static void print_features(const char *path, const char *body)
{
    static const char *const classes[] = {"left", "straight", "right"};
    const char *distances = strstr(body, "\"distances_m\""), *heading = strstr(body, "\"heading\"");
    static const char *const markings[] = {"ml", "mr"};
    printf("%s:", path);
    for (int k = 0; k < 2; k++) {
        double metres = number(distances, markings[k], 1e9);
        if (metres < 1e9)
            printf(" %s %.3f m", markings[k], metres);
        else
            printf(" %s absent", markings[k]); /* null: the car is not in the middle of a lane */
    }
    int best = 0;
    for (int k = 1; k < 3; k++)
        if (number(heading, classes[k], 0) > number(heading, classes[best], 0))
            best = k;
    printf(" angle %.4f rad class %s\n", number(body, "angle_rad", 0), classes[best]);
}

/* Asks until there is an answer or no time left; whether there was one. */
static int features(int *connection, const char *host, const char *port, const char *path,
                    const char *image, size_t length)
{
    static struct answer answer;
    const double end = now_s() + GIVE_UP_S;
    for (;;) {
        if (*connection < 0)
            *connection = dial(host, port);
        answer.status = 0;
        if (*connection >= 0)
            ask(*connection, host, image, length, &answer);
        if (*connection >= 0 && (answer.status == 0 || !answer.keep)) {
            close(*connection); /* a service that restarts closes it; the next ask dials anew */
            *connection = -1;
        }
        if (answer.status == 200) {
            print_features(path, answer.body);
            return 1;
        }
        int again = answer.status == 0 || answer.status == 503 || answer.status == 429;
        double wait_ms = answer.status != 0 && answer.retry_after_ms >= 0 ? answer.retry_after_ms : 100;
        if (!again || now_s() + wait_ms / 1e3 > end) {
            fprintf(stderr, "%s: status %d %s\n", path, answer.status,
                    answer.status ? answer.body : "(no answer)");
            return 0;
        }
        pause_ms(wait_ms);
    }
}

int main(int count, char **words)
{
    static char image[MAX_IMAGE + 1];
    int connection = -1, failed = 0;
    if (count < 4) {
        fprintf(stderr, "usage: %s HOST PORT IMAGE...\n", words[0]);
        return 2;
    }
    for (int k = 3; k < count; k++) {
        FILE *file = fopen(words[k], "rb");
        size_t length = file == NULL ? 0 : fread(image, 1, sizeof image, file);
        if (file == NULL || ferror(file) || length == 0 || length > MAX_IMAGE) {
            fprintf(stderr, "%s: not readable, empty or over %d bytes\n", words[k], MAX_IMAGE);
            failed = 1;
        } else if (!features(&connection, words[1], words[2], words[k], image, length)) {
            failed = 1;
        }
        if (file != NULL)
            fclose(file);
    }
    if (connection >= 0)
        close(connection);
    return failed;
}
