#ifndef CHELPER_PORTTHREAD_H
#define CHELPER_PORTTHREAD_H
// A thread that carries bytes between one file descriptor (serial port, pty, socket) and one serialqueue, so that
// acknowledgements and retransmissions never wait for Python.

struct portthread;
struct serialqueue;

// The thread writes one byte to notify_fd (non-blocking) whenever messages wait for the host (and
// may wait no longer: serialqueue_set_batch), and once when the port
// fails. Both descriptors stay the caller's to close, after portthread_stop. NULL if no thread could be started.
struct portthread *portthread_start(struct serialqueue *sq, int fd, int notify_fd);
void portthread_kick(struct portthread *pt);  // something was queued
// errno that ended the work on the port; 0 while it works; -1 = end of file
int portthread_error(struct portthread *pt);
void portthread_stop(struct portthread *pt);  // ends and frees it

#endif
