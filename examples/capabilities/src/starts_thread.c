/* Starts a thread with its instance, which waits until the instance is freed. */
#include "lag.h"

#include <pthread.h>

typedef struct {
    pthread_t thread;
    pthread_mutex_t mutex;
    pthread_cond_t changed;
    bool is_to_end;
} Worker;

static void *wait_for_the_end(void *block)
{
    Worker *worker = block;
    pthread_mutex_lock(&worker->mutex);
    while (!worker->is_to_end)
        pthread_cond_wait(&worker->changed, &worker->mutex);
    pthread_mutex_unlock(&worker->mutex);
    return NULL;
}

static const char *open_worker(void *hidden, const char *resources)
{
    Worker *worker = hidden;
    (void)resources;
    pthread_mutex_init(&worker->mutex, NULL);
    pthread_cond_init(&worker->changed, NULL);
    if (pthread_create(&worker->thread, NULL, wait_for_the_end, worker) == 0)
        return NULL;
    pthread_cond_destroy(&worker->changed);
    pthread_mutex_destroy(&worker->mutex);
    return "the thread cannot be started";
}

static void close_worker(void *hidden)
{
    Worker *worker = hidden;
    pthread_mutex_lock(&worker->mutex);
    worker->is_to_end = true;
    pthread_cond_signal(&worker->changed);
    pthread_mutex_unlock(&worker->mutex);
    pthread_join(worker->thread, NULL);
    pthread_cond_destroy(&worker->changed);
    pthread_mutex_destroy(&worker->mutex);
}

const Behaviour behaviour = {.state_size = sizeof(Lag),
                             .hidden_size = sizeof(Worker),
                             LAG_BEHAVIOUR,
                             .step = lag_step,
                             .open = open_worker,
                             .close = close_worker};
