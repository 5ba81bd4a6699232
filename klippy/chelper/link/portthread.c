// Thread that owns the I/O of one port. All decisions are serialqueue's; here bytes are only moved.

#define _GNU_SOURCE
#include "portthread.h"
#include "serialqueue.h"
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

enum {
    READ_SIZE = 4096,
    POLL_MAX_MS = 1000, // look around at least once a second
    CAN_DATA_MAX = 8,
};

static const double CAN_FULL_WAIT_S = 0.0005; // some frames of 1 Mbit/s

// As the kernel hands out CAN 2.0 frames (linux/can.h, which not every system has)
struct can_packet {
    uint32_t id;
    uint8_t len, reserved[3];
    uint8_t data[CAN_DATA_MAX];
};
_Static_assert(sizeof(struct can_packet) == 16, "size of a SocketCAN frame");

struct portthread {
    struct serialqueue *sq;
    int fd, notify_fd;
    uint32_t can_id; // of what the host sends; 0: no CAN
    int wake_read, wake_write;
    pthread_t thread;
    atomic_int stopping, error;
    int has_news; // the host may have messages and is not notified yet
    uint8_t out[SERIALQUEUE_TRANSMIT_MIN]; // bytes the port has not taken yet
    int out_start, out_end;
};

static double
monotonic_now(void)
{
    struct timespec ts;
    clock_gettime(CLOCK_MONOTONIC, &ts);
    return (double)ts.tv_sec + (double)ts.tv_nsec * 1e-9;
}

static void
poke(int fd)
{
    ssize_t ignored = write(fd, "", 1); // a full pipe has woken the reader already
    (void)ignored;
}

static void
fail(struct portthread *pt, int code)
{
    atomic_store(&pt->error, code);
    poke(pt->notify_fd);
}

// One packet of a CAN bus into `data`. As read(), with 0 for a packet of somebody else.
static ssize_t
read_packet(struct portthread *pt, uint8_t *data)
{
    struct can_packet packet;
    ssize_t n = read(pt->fd, &packet, sizeof(packet));
    if (n < 0)
        return n;
    if (n != sizeof(packet) || packet.id != pt->can_id + 1 || packet.len > CAN_DATA_MAX)
        return 0;
    memcpy(data, packet.data, packet.len);
    return packet.len;
}

static void
read_port(struct portthread *pt)
{
    uint8_t data[READ_SIZE];
    ssize_t n = pt->can_id ? read_packet(pt, data) : read(pt->fd, data, sizeof(data));
    if (n > 0) {
        serialqueue_receive(pt->sq, data, (int)n, monotonic_now());
        pt->has_news = 1;
    } else if (!n) {
        if (!pt->can_id)
            fail(pt, -1);
    } else if (errno != EAGAIN && errno != EINTR) {
        fail(pt, errno);
    }
}

// Some of the bytes that are to go out. As write().
static ssize_t
write_some(struct portthread *pt)
{
    const uint8_t *data = pt->out + pt->out_start;
    int count = pt->out_end - pt->out_start;
    if (!pt->can_id)
        return write(pt->fd, data, (size_t)count);
    struct can_packet packet = {.id = pt->can_id, .len = (uint8_t)(count < CAN_DATA_MAX ? count : CAN_DATA_MAX)};
    memcpy(packet.data, data, packet.len);
    ssize_t n = write(pt->fd, &packet, sizeof(packet));
    return n < 0 ? n : packet.len;
}

// Send what is due. Returns when to look again.
static double
write_port(struct portthread *pt)
{
    double next_wake = SERIALQUEUE_NEVER;
    for (;;) {
        if (pt->out_start == pt->out_end) {
            pt->out_start = 0;
            pt->out_end = serialqueue_transmit(pt->sq, pt->out, sizeof(pt->out), monotonic_now(), &next_wake);
            if (!pt->out_end)
                return next_wake;
        }
        ssize_t n = write_some(pt);
        if (n < 0) {
            if (errno == ENOBUFS) // the interface's queue is full, which poll() does not know
                return monotonic_now() + CAN_FULL_WAIT_S;
            if (errno != EAGAIN && errno != EINTR)
                fail(pt, errno);
            return next_wake; // poll() returns when there is room
        }
        pt->out_start += (int)n;
    }
}

// Wake the host when something waits for it that can not wait longer. Returns when to look again.
static double
report_to_host(struct portthread *pt)
{
    if (!pt->has_news)
        return SERIALQUEUE_NEVER;
    double due = serialqueue_host_due(pt->sq);
    if (due <= monotonic_now()) {
        poke(pt->notify_fd);
        pt->has_news = 0;
        return SERIALQUEUE_NEVER;
    }
    return due;
}

static int
poll_timeout_ms(double next_wake)
{
    double wait_s = next_wake - monotonic_now();
    if (wait_s <= 0.0)
        return 0;
    return wait_s * 1000.0 < POLL_MAX_MS ? (int)(wait_s * 1000.0) + 1 : POLL_MAX_MS;
}

static void *
port_loop(void *arg)
{
    struct portthread *pt = arg;
    while (!atomic_load(&pt->stopping)) {
        double next_report = report_to_host(pt);
        int broken = atomic_load(&pt->error);
        double next_wake = broken ? SERIALQUEUE_NEVER : write_port(pt);
        next_wake = next_report < next_wake ? next_report : next_wake;
        int has_output = pt->out_start != pt->out_end;
        struct pollfd fds[2] = {
            {.fd = pt->wake_read, .events = POLLIN},
            {.fd = pt->fd, .events = (short)(POLLIN | (has_output ? POLLOUT : 0))},
        };
        int watched = atomic_load(&pt->error) ? 1 : 2;
        if (poll(fds, (nfds_t)watched, poll_timeout_ms(next_wake)) <= 0)
            continue;
        if (fds[0].revents) {
            uint8_t drain[64];
            ssize_t ignored = read(pt->wake_read, drain, sizeof(drain));
            (void)ignored;
        }
        if (watched == 2 && fds[1].revents & (POLLIN | POLLHUP | POLLERR | POLLNVAL))
            read_port(pt);
    }
    return NULL;
}

static void
release(struct portthread *pt)
{
    close(pt->wake_read);
    close(pt->wake_write);
    free(pt);
}

struct portthread *
portthread_start(struct serialqueue *sq, int fd, int notify_fd, uint32_t can_id)
{
    struct portthread *pt = calloc(1, sizeof(*pt));
    int wake[2];
    if (!pt || pipe2(wake, O_NONBLOCK | O_CLOEXEC)) {
        free(pt);
        return NULL;
    }
    pt->sq = sq;
    pt->fd = fd;
    pt->notify_fd = notify_fd;
    pt->can_id = can_id;
    pt->wake_read = wake[0];
    pt->wake_write = wake[1];
    if (pthread_create(&pt->thread, NULL, port_loop, pt)) {
        release(pt);
        return NULL;
    }
    return pt;
}

void
portthread_kick(struct portthread *pt)
{
    poke(pt->wake_write);
}

int
portthread_error(struct portthread *pt)
{
    return atomic_load(&pt->error);
}

void
portthread_stop(struct portthread *pt)
{
    atomic_store(&pt->stopping, 1);
    poke(pt->wake_write);
    pthread_join(pt->thread, NULL);
    release(pt);
}
