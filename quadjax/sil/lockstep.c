/* Preloaded into Betaflight's firmware ("software in the loop" build): a clock of simulated time.
 *
 * The clock rises by READ_NS whenever the main thread reads it, and stops BOOT_NS after the start.
 * Then each state with its sticks allows STEP_NS more.
 * A state is handled while the main thread stands still, so a flight depends neither on the speed
 * nor on the load of the machine. After a state of a negative time the clock does not stop again.
 * One thread of the firmware runs at a time, the one that holds "turn": it is not safe otherwise.
 * Sockets have free ports of the loopback. Motors go to the port QUADJAX_MOTORS, and so does, when
 * the clock stops first, a packet with the ports of state, sticks and command line. The process ends
 * with the one that started it. */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <dlfcn.h>
#include <errno.h>
#include <pthread.h>
#include <signal.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/prctl.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <time.h>

enum { MOTORS = 9002, STATE = 9003, STICKS = 9004, COMMAND_LINE = 5761 }; /* fixed ports */
enum { READ_NS = 1000, STEP_NS = 1000000, PAUSE_NS = 100000, THREADS = 8 };
#define BOOT_NS 3000000000LL
#define NEXT(function) *(void **)&next = dlsym(RTLD_NEXT, function)

static pthread_mutex_t turn = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t changed = PTHREAD_COND_INITIALIZER;
static long long now, end = BOOT_NS; /* ns */
static int free_running, standing, threads;
static unsigned long states, sticks; /* that have been handled */
static __thread int is_main, handled; /* the fixed port of the packet that this thread handles */
static int state_fd, sticks_fd, line_fd, motors_fd;
static struct sockaddr_in motors; /* the other end */
static struct {
    void *(*function)(void *);
    void *data;
} started[THREADS];

__attribute__((constructor)) static void start(void) {
    prctl(PR_SET_PDEATHSIG, SIGKILL);
    is_main = 1;
    pthread_mutex_lock(&turn);
    motors.sin_family = AF_INET;
    motors.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    motors_fd = socket(AF_INET, SOCK_DGRAM, 0);
    bind(motors_fd, (struct sockaddr *)&motors, sizeof motors);
    motors.sin_port = htons((uint16_t)atoi(getenv("QUADJAX_MOTORS")));
}

static ssize_t send_motors(const void *data, size_t size) {
    ssize_t (*next)(int, const void *, size_t, int, const struct sockaddr *, socklen_t);
    NEXT("sendto");
    return next(motors_fd, data, size, 0, (struct sockaddr *)&motors, sizeof motors);
}

static void *in_turn(void *one) {
    int number = (int)(long)one;
    void *result;
    pthread_mutex_lock(&turn);
    result = started[number].function(started[number].data);
    pthread_mutex_unlock(&turn);
    return result;
}

int pthread_create(pthread_t *thread, const pthread_attr_t *attributes,
                   void *(*function)(void *), void *data) {
    int (*next)(pthread_t *, const pthread_attr_t *, void *(*)(void *), void *);
    NEXT("pthread_create");
    if (threads == THREADS) return EAGAIN;
    started[threads].function = function;
    started[threads].data = data;
    return next(thread, attributes, in_turn, (void *)(long)threads++);
}

int pthread_join(pthread_t thread, void **result) {
    int (*next)(pthread_t, void **), failed;
    NEXT("pthread_join");
    pthread_mutex_unlock(&turn);
    failed = next(thread, result);
    pthread_mutex_lock(&turn);
    return failed;
}

static uint16_t port_of(int fd) {
    struct sockaddr_in own;
    socklen_t length = sizeof own;
    return getsockname(fd, (struct sockaddr *)&own, &length) ? 0 : ntohs(own.sin_port);
}

static void report_ports(void) {
    uint16_t ports[] = {port_of(state_fd), port_of(sticks_fd), port_of(line_fd)};
    send_motors(ports, sizeof ports);
}

static void advance(long long ns) {
    while (now + ns > end && !free_running) {
        ns -= end - now;
        now = end;
        standing = 1;
        pthread_cond_broadcast(&changed);
        if (end == BOOT_NS) report_ports();
        while (standing && !free_running) pthread_cond_wait(&changed, &turn);
    }
    now += ns;
}

int clock_gettime(clockid_t clock, struct timespec *time) {
    (void)clock;
    if (is_main) advance(READ_NS);
    time->tv_sec = now / 1000000000;
    time->tv_nsec = now % 1000000000;
    return 0;
}

/* In flight without the pause after each turn of the main loop, which no board has. */
int nanosleep(const struct timespec *wanted, struct timespec *left) {
    int (*next)(const struct timespec *, struct timespec *);
    long long ns = wanted->tv_sec * 1000000000LL + wanted->tv_nsec;
    NEXT("nanosleep");
    if (is_main) advance(ns < PAUSE_NS && !free_running ? READ_NS : ns);
    if (is_main && !free_running) return 0;
    pthread_mutex_unlock(&turn);
    next(wanted, left);
    pthread_mutex_lock(&turn);
    return 0;
}

/* A packet waits until the main thread stands still, and sticks for the state before them. */
ssize_t recvfrom(int fd, void *data, size_t size, int flags, struct sockaddr *from,
                 socklen_t *length) {
    ssize_t (*next)(int, void *, size_t, int, struct sockaddr *, socklen_t *), got;
    NEXT("recvfrom");
    got = next(fd, data, size, flags, from, length);
    handled = got <= 0 ? 0 : fd == state_fd ? STATE : fd == sticks_fd ? STICKS : 0;
    if (handled == STATE && *(double *)data < 0.0) free_running = 1;
    while (handled && !free_running && (!standing || (handled == STICKS && sticks > states)))
        pthread_cond_wait(&changed, &turn);
    return got;
}

/* A thread that waits for its next packet has handled the last. */
int select(int count, fd_set *in, fd_set *out, fd_set *other, struct timeval *timeout) {
    int (*next)(int, fd_set *, fd_set *, fd_set *, struct timeval *), ready;
    NEXT("select");
    sticks += handled == STICKS;
    if (handled == STATE) {
        while (sticks <= states && !free_running) pthread_cond_wait(&changed, &turn);
        states++;
        end += STEP_NS;
        standing = 0;
    }
    if (handled) pthread_cond_broadcast(&changed);
    handled = 0;
    pthread_mutex_unlock(&turn);
    ready = next(count, in, out, other, timeout);
    pthread_mutex_lock(&turn);
    return ready;
}

ssize_t sendto(int fd, const void *data, size_t size, int flags, const struct sockaddr *to,
               socklen_t length) {
    (void)fd, (void)flags, (void)length;
    if (((const struct sockaddr_in *)to)->sin_port != htons(MOTORS)) return (ssize_t)size;
    return send_motors(data, size);
}

int bind(int fd, const struct sockaddr *wanted, socklen_t length) {
    int (*next)(int, const struct sockaddr *, socklen_t);
    struct sockaddr_in at = {.sin_family = AF_INET};
    int port = ntohs(((const struct sockaddr_in *)wanted)->sin_port);
    (void)length;
    NEXT("bind");
    if (port == STATE) state_fd = fd;
    if (port == STICKS) sticks_fd = fd;
    if (port == COMMAND_LINE) line_fd = fd;
    at.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    return next(fd, (struct sockaddr *)&at, sizeof at);
}
