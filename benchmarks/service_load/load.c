/* load.c: asks an HTTP server the same thing over and over, from one thread.
 *
 *   load PORT CONNECTIONS SECONDS RATE FILE
 *
 * FILE holds the bytes of one request. RATE 0: each connection asks again when it has its answer
 * (closed loop). Else requests are due at RATE a second, whatever becomes of them (open loop): one
 * that finds no free connection waits, and its time counts from when it was due. A line of stdout
 * a request: when it was due (s), its time (ms), the status of its answer (0: the connection broke).
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <netinet/tcp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { ANSWER = 1 << 16, EVENTS = 256 };

struct client {
    int fd, busy;
    double due;
    size_t sent, got;
    char answer[ANSWER + 1];
};

static struct client *clients;
static int count, poller;
static struct sockaddr_in server = {.sin_family = AF_INET};
static char *request;
static size_t length;

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}

static void watch(struct client *c, int how, int what) {
    struct epoll_event event = {.events = what, .data.ptr = c};
    epoll_ctl(poller, how, c->fd, &event);
}

static void dial(struct client *c) {
    int one = 1;
    c->fd = socket(AF_INET, SOCK_STREAM, 0);
    if (connect(c->fd, (struct sockaddr *)&server, sizeof server)) {
        perror("load: connect");
        exit(1);
    }
    setsockopt(c->fd, IPPROTO_TCP, TCP_NODELAY, &one, sizeof one);
    fcntl(c->fd, F_SETFL, O_NONBLOCK);
    watch(c, EPOLL_CTL_ADD, EPOLLIN);
}

static void end(struct client *c, int status, double begin) {
    printf("%.6f %.4f %d\n", c->due - begin, 1e3 * (now() - c->due), status);
    c->busy = 0;
    if (status) return;
    close(c->fd);
    dial(c);
}

/* Send what is left of the request; 0: the connection broke. */
static int send_rest(struct client *c) {
    while (c->sent < length) {
        ssize_t n = send(c->fd, request + c->sent, length - c->sent, MSG_NOSIGNAL);
        if (n < 0 && errno == EAGAIN) {
            watch(c, EPOLL_CTL_MOD, EPOLLIN | EPOLLOUT);
            return 1;
        }
        if (n < 0) return 0;
        c->sent += n;
        if (c->sent == length) watch(c, EPOLL_CTL_MOD, EPOLLIN);
    }
    return 1;
}

static void ask(struct client *c, double due, double begin) {
    c->busy = 1, c->due = due, c->sent = c->got = 0;
    if (!send_rest(c)) end(c, 0, begin);
}

/* The status of a whole answer; -1: more is to come; 0: it broke. */
static int read_answer(struct client *c) {
    ssize_t n = recv(c->fd, c->answer + c->got, ANSWER - c->got, 0);
    if (n < 0 && errno == EAGAIN) return -1;
    if (n <= 0) return 0;
    c->got += n;
    c->answer[c->got] = 0;
    char *body = strstr(c->answer, "\r\n\r\n");
    if (!body) return -1;
    char *field = strcasestr(c->answer, "\r\ncontent-length:");
    if (!field || field > body) return 0;
    size_t whole = body + 4 - c->answer + strtoul(field + 17, NULL, 10);
    return c->got < whole ? -1 : atoi(c->answer + 9);
}

static void handle(struct epoll_event *event, double begin) {
    struct client *c = event->data.ptr;
    if (event->events & EPOLLOUT && c->busy && !send_rest(c)) {
        end(c, 0, begin);
        return;
    }
    if (!(event->events & ~EPOLLOUT)) return;
    int status = read_answer(c);
    if (status > 0 || (status == 0 && c->busy)) {
        end(c, status, begin);
    } else if (status == 0) { /* closed while it rested */
        close(c->fd);
        dial(c);
    }
}

static struct client *free_client(void) {
    static int last;
    for (int i = 0; i < count; i++) {
        last = (last + 1) % count;
        if (!clients[last].busy) return &clients[last];
    }
    return NULL;
}

int main(int number, char **arguments) {
    if (number != 6) {
        fputs("usage: load PORT CONNECTIONS SECONDS RATE FILE\n", stderr);
        return 2;
    }
    FILE *file = fopen(arguments[5], "rb");
    if (!file || fseek(file, 0, SEEK_END)) return 2;
    length = ftell(file);
    rewind(file);
    request = malloc(length);
    if (fread(request, 1, length, file) != length) return 2;
    server.sin_port = htons(atoi(arguments[1]));
    server.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    count = atoi(arguments[2]);
    double seconds = atof(arguments[3]), rate = atof(arguments[4]);
    clients = calloc(count, sizeof *clients);
    poller = epoll_create1(0);
    for (int i = 0; i < count; i++) dial(&clients[i]);
    double begin = now(), stop = begin + seconds;
    long asked = 0, busy = 0;
    struct epoll_event events[EVENTS];
    do {
        double t = now();
        struct client *c;
        while (t < stop && (rate == 0 || begin + asked / rate <= t) && (c = free_client())) {
            ask(c, rate == 0 ? t : begin + asked / rate, begin);
            asked++;
        }
        double wait = rate == 0 ? 0.1 : begin + asked / rate - now();
        struct timespec pause = {0, wait > 0 ? (long)(1e9 * (wait < 0.1 ? wait : 0.1)) : 100000};
        int n = epoll_pwait2(poller, events, EVENTS, &pause, NULL);
        for (int i = 0; i < n; i++) handle(&events[i], begin);
        for (int i = busy = 0; i < count; i++) busy += clients[i].busy;
    } while (now() < stop || (busy && now() < stop + 5));
    return 0;
}
