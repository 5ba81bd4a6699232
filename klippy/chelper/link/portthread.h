#ifndef CHELPER_PORTTHREAD_H
#define CHELPER_PORTTHREAD_H
// A thread that carries bytes between one file descriptor (serial port, pty, socket) and one serialqueue, so that
// acknowledgements and retransmissions never wait for Python.

#include <stdint.h>

struct portthread;
struct serialqueue;

// The thread writes one byte to notify_fd (non-blocking) whenever messages wait for the host (and
// may wait no longer: serialqueue_set_batch), and once when the port
// fails. Both descriptors stay the caller's to close, after portthread_stop. NULL if no thread could be started.
// can_id 0: fd carries plain bytes. Else fd is a SocketCAN raw socket: bytes go out in frames of this id, those of the
// next id are the MCU's.
struct portthread *portthread_start(struct serialqueue *sq, int fd, int notify_fd, uint32_t can_id);
void portthread_kick(struct portthread *pt);  // something was queued
// errno that ended the work on the port; 0 while it works; -1 = end of file
int portthread_error(struct portthread *pt);
void portthread_stop(struct portthread *pt);  // ends and frees it

#endif
