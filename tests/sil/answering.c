/* In place of Betaflight's firmware: answers each state at once, with its clock, s. */
#include <arpa/inet.h>
#include <pthread.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <time.h>

static int state, sticks;

static struct sockaddr_in of(int port) {
    struct sockaddr_in at = {.sin_family = AF_INET, .sin_port = htons((unsigned short)port)};
    at.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    return at;
}

static void *answer(void *link) {
    int fd = *(int *)link;
    struct sockaddr_in to = of(9002);
    double packet[18];
    struct timespec now;
    fd_set fds;
    for (;;) {
        FD_ZERO(&fds);
        FD_SET(fd, &fds);
        select(fd + 1, &fds, 0, 0, 0);
        recvfrom(fd, packet, sizeof packet, 0, 0, 0);
        clock_gettime(CLOCK_MONOTONIC, &now);
        packet[0] = now.tv_sec + 1e-9 * now.tv_nsec;
        if (link == &state) sendto(fd, packet, 16, 0, (struct sockaddr *)&to, sizeof to);
    }
    return 0;
}

static void serve(int *link, int port) {
    struct sockaddr_in at = of(port);
    pthread_t thread;
    *link = socket(AF_INET, SOCK_DGRAM, 0);
    bind(*link, (struct sockaddr *)&at, sizeof at);
    pthread_create(&thread, 0, answer, link);
}

int main(void) {
    struct timespec now;
    serve(&state, 9003);
    serve(&sticks, 9004);
    for (;;) clock_gettime(CLOCK_MONOTONIC, &now);
}
