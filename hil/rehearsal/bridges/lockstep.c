/* Loaded into Betaflight's process (LD_PRELOAD): its clock goes by what the bridge sends, not by the wall's.

The clock begins at a fixed time and advances by the times that the main thread sleeps and a little for each look at it. After
START_NS, and from then on at the stamp of each packet of samples, the main thread stands still. A datagram may hold several packets:
the firmware is given one after the other. After the last one its serial ports send what they have, it says so on a pipe
(VISTHROW_STANDS) with the motor outputs since the last time, and waits for the next datagram. What has come on the ports meanwhile is
taken in before it goes on. So a flight is the same on any machine, as slow or as fast as it is.

The firmware opens its ports in the main thread while the ports' thread begins to serve them. Where that thread is late, it takes a port
that is half open for a closed one and frees it: peers connect and are never heard. So the main thread binds nothing before that thread
waits for its first turn.

Source: betaflight 4.6, src/platform/SIMULATOR/sitl.c (micros64, updateState, udpThread, tcpThread), udplink.c, lib/main/dyad
(dyad_newStream, destroyClosedStreams, dyad_update). */

#define _GNU_SOURCE
#include <netinet/in.h>
#include <pthread.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#define START_NS 2000000000LL           /* for sensors and ports to be begun */
enum { LOOK_NS = 100, SAMPLES = 144, MOST = 16, TURNS = 4, MOTORS = 9002, RAW_MOTORS = 9001, OUTPUTS = 16 };

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t granted = PTHREAD_COND_INITIALIZER, stood = PTHREAD_COND_INITIALIZER, served = PTHREAD_COND_INITIALIZER,
                      serving = PTHREAD_COND_INITIALIZER;  /* of what waits: the main thread, the samples', who lets ports serve, these */
static int turns, waits;                /* turns that the ports may take; whether they wait for some */
static int64_t now_ns = 1000000000LL, limit_ns = 1000000000LL + START_NS;
static int stands, last = 1;            /* whether the main thread stands; whether the packet that it stands at ends its datagram */
static struct { int64_t now_ns; char outputs[2 * MOST * OUTPUTS]; } told;  /* what is said on the pipe */
static size_t outputs;                  /* bytes of it */
static __thread char packets[MOST * SAMPLES];
static __thread size_t size, taken;     /* of them; those that the firmware has */
static __thread int sampled;            /* one was taken, and is dealt with when this thread waits for the next */
static __thread double stamp;

static int is_main(void) {
    static __thread int known;
    if (!known) known = 1 + (syscall(SYS_gettid) == getpid());
    return known == 2;
}

static void serve_ports(void) {         /* bytes that have come go in, answers go out; called with the lock held */
    turns = TURNS;
    pthread_cond_signal(&serving);
    while (turns > 0 || !waits) pthread_cond_wait(&served, &lock);
}

static void stand(void) {
    const char *name = getenv("VISTHROW_STANDS");
    pthread_mutex_lock(&lock);
    while (now_ns >= limit_ns) {
        if (last) {
            serve_ports();
            told.now_ns = now_ns;
            size_t length = sizeof told.now_ns + outputs;
            outputs = 0;
            if (name && write(atoi(name), &told, length) != (ssize_t)length) _exit(1);
        }
        stands = 1;
        pthread_cond_signal(&stood);
        while (stands) pthread_cond_wait(&granted, &lock);
    }
    pthread_mutex_unlock(&lock);
}

static void grant(void) {
    sampled = 0;
    pthread_mutex_lock(&lock);
    if (last) serve_ports();
    limit_ns = 1000000000LL + START_NS + (int64_t)(1e9 * stamp + 0.5);
    last = taken == size;
    stands = 0;
    pthread_cond_signal(&granted);
    while (!last && !stands) pthread_cond_wait(&stood, &lock);
    pthread_mutex_unlock(&lock);
}

int clock_gettime(clockid_t id, struct timespec *t) {
    if (id != CLOCK_MONOTONIC) return syscall(SYS_clock_gettime, id, t);
    int64_t ns = __atomic_add_fetch(&now_ns, is_main() ? LOOK_NS : 0, __ATOMIC_SEQ_CST);
    t->tv_sec = ns / 1000000000LL;
    t->tv_nsec = ns % 1000000000LL;
    return 0;
}

int nanosleep(const struct timespec *want, struct timespec *left) {
    if (!is_main()) return syscall(SYS_nanosleep, want, left);
    int64_t ns = __atomic_add_fetch(&now_ns, want->tv_sec * 1000000000LL + want->tv_nsec, __ATOMIC_SEQ_CST);
    if (ns >= __atomic_load_n(&limit_ns, __ATOMIC_SEQ_CST)) stand();
    return 0;
}

int bind(int fd, const struct sockaddr *address, socklen_t length) {
    pthread_mutex_lock(&lock);
    while (is_main() && !waits) pthread_cond_wait(&served, &lock);
    pthread_mutex_unlock(&lock);
    return syscall(SYS_bind, fd, address, length);
}

ssize_t sendto(int fd, const void *data, size_t length, int flags, const struct sockaddr *to, socklen_t room) {
    int port = to && to->sa_family == AF_INET ? ntohs(((const struct sockaddr_in *)to)->sin_port) : 0;
    if (port == RAW_MOTORS) return length;              /* nobody listens */
    if (port != MOTORS) return syscall(SYS_sendto, fd, data, length, flags, to, room);
    pthread_mutex_lock(&lock);
    if (outputs + length <= sizeof told.outputs) {
        memcpy(told.outputs + outputs, data, length);
        outputs += length;
    }
    pthread_mutex_unlock(&lock);
    return length;
}

ssize_t recvfrom(int fd, void *data, size_t room, int flags, struct sockaddr *from, socklen_t *length) {
    if (room != SAMPLES) return syscall(SYS_recvfrom, fd, data, room, flags, from, length);
    if (taken == size) {
        ssize_t got = syscall(SYS_recvfrom, fd, packets, sizeof packets, flags, from, length);
        taken = size = 0;
        if (got <= 0 || got % SAMPLES) return got;
        size = got;
    }
    memcpy(data, packets + taken, SAMPLES);
    taken += SAMPLES;
    stamp = *(double *)data;
    *(double *)data = 1.0;              /* stamps that stand still leave the rate of the firmware's clock at 1 */
    sampled = 1;
    return SAMPLES;
}

int select(int count, fd_set *reads, fd_set *writes, fd_set *faults, struct timeval *most) {
    if (sampled) grant();
    if (taken < size) return 1;         /* the next packet of its datagram */
    int ports = most && most->tv_sec == 0 && most->tv_usec < 20000;  /* their thread waits for 10 ms, the others for 100 */
    if (ports) {
        pthread_mutex_lock(&lock);
        waits = 1;
        if (turns == 0) pthread_cond_broadcast(&served);
        while (turns == 0) pthread_cond_wait(&serving, &lock);
        waits = 0;
        turns--;
        pthread_mutex_unlock(&lock);
        most->tv_usec = 0;
    }
    struct timespec time, *limit = NULL;
    if (most) {
        time.tv_sec = most->tv_sec;
        time.tv_nsec = 1000L * most->tv_usec;
        limit = &time;
    }
    int ready = syscall(SYS_pselect6, count, reads, writes, faults, limit, NULL);
    if (ready == 0 && ports) {          /* nothing to take in and nothing to send: further turns would find the same */
        pthread_mutex_lock(&lock);
        turns = 0;
        pthread_mutex_unlock(&lock);
    }
    return ready;
}
