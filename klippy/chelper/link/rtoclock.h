#ifndef CHELPER_RTOCLOCK_H
#define CHELPER_RTOCLOCK_H
// How long to wait for an acknowledgement before sending again: RFC 6298 with the bounds this wire calls for.

// RFC 6298 wants one second at least; a printer's link is short and its MCU answers within milliseconds.
#define RTO_MIN_S 0.025
#define RTO_MAX_S 5.0
#define RTO_START_S 0.1 // before the first measurement
// Once the round trip is measured, a first second of silence is not doubled beyond this: a line that was cut for less is
// used again this soon after. Motion is planned for less than a second (BUFFER_FULL_S of the toolhead).
#define RTO_BACKOFF_S 0.05
#define RTO_BACKOFFS 20

struct rtoclock {
    double srtt_s, rttvar_s, rto_s;
    int has_sample, backoffs; // in a row
};

static inline double
rto_clamp(double rto_s)
{
    return rto_s < RTO_MIN_S ? RTO_MIN_S : rto_s > RTO_MAX_S ? RTO_MAX_S : rto_s;
}

static inline void
rtoclock_init(struct rtoclock *r)
{
    *r = (struct rtoclock) {.rto_s = RTO_START_S};
}

// A block sent exactly once was acknowledged after rtt_s (Karn: never call it for one sent twice). Section 2.2, 2.3.
static inline void
rtoclock_sample(struct rtoclock *r, double rtt_s)
{
    if (!r->has_sample) {
        r->has_sample = 1;
        r->srtt_s = rtt_s;
        r->rttvar_s = rtt_s / 2.0;
    } else {
        double deviation_s = r->srtt_s > rtt_s ? r->srtt_s - rtt_s : rtt_s - r->srtt_s;
        r->rttvar_s += (deviation_s - r->rttvar_s) / 4.0;
        r->srtt_s += (rtt_s - r->srtt_s) / 8.0;
    }
    r->rto_s = rto_clamp(r->srtt_s + 4.0 * r->rttvar_s);
    r->backoffs = 0;
}

// Something new was acknowledged, though nothing can be measured by it: the link is alive, the doubling has done its
// work. Kept, it would turn each later loss on a line that loses often into a long silence.
static inline void
rtoclock_progress(struct rtoclock *r)
{
    r->backoffs = 0;
    if (r->has_sample)
        r->rto_s = rto_clamp(r->srtt_s + 4.0 * r->rttvar_s);
}

// The timer expired. Section 5.5, but see RTO_BACKOFF_S.
static inline void
rtoclock_backoff(struct rtoclock *r)
{
    double doubled_s = 2.0 * r->rto_s;
    if (r->has_sample && r->backoffs++ < RTO_BACKOFFS && doubled_s > RTO_BACKOFF_S)
        doubled_s = r->rto_s > RTO_BACKOFF_S ? r->rto_s : RTO_BACKOFF_S;
    r->rto_s = rto_clamp(doubled_s);
}

#endif
