// A pool of threads that run the shares of a *phase*. Share i of n is the same work on any thread, so that results are
// bit-for-bit reproducible for a fixed number of shares.
//
// OpenMP is not used because some compilers lack it, and because its idle threads spin, which blocks cores of a busy
// machine. Threads of this pool spin for microseconds, then yield to other processes for about a millisecond, longer than
// most pauses between the phases of a training step, then sleep: waking up would take about as long as a phase.
#pragma once
#include "simd.h"

#if defined(__unix__) || defined(__APPLE__)
// With a just-in-time compiler no library is linked; these are pointers then, which the loader of the kernels sets.
#if defined(JUST_IN_TIME)
#define FROM_SYSTEM(name, ...) static int (*name)(__VA_ARGS__);
#else
#define FROM_SYSTEM(name, ...) extern "C" int name(__VA_ARGS__);
#endif
FROM_SYSTEM(pthread_create, void*, const void*, void* (*)(void*), void*)
FROM_SYSTEM(pthread_mutex_init, void*, const void*)
FROM_SYSTEM(pthread_mutex_lock, void*)
FROM_SYSTEM(pthread_mutex_unlock, void*)
FROM_SYSTEM(pthread_cond_init, void*, const void*)
FROM_SYSTEM(pthread_cond_wait, void*, void*)
FROM_SYSTEM(pthread_cond_broadcast, void*)
FROM_SYSTEM(getpid)
FROM_SYSTEM(sched_yield)

enum { MAX_WORKERS = 255, SPINS = 2000, YIELDS = 2000 };

struct Pool {
    // Larger than the mutexes and condition variables of all systems.
    alignas(64) char mutex[256], wake[256], done[256];
    int n_workers, pid, busy;
    int generation, left;   // number of the current phase, and of workers that have not finished it
    void (*phase)(void*, int);
    void* context;
    int shares;
    struct Start {
        int worker, generation;
    } starts[MAX_WORKERS + 1];
};
static Pool pool;

INLINE int peek(const int* x) { return __atomic_load_n(x, __ATOMIC_ACQUIRE); }
INLINE void pause_briefly() {
#if defined(__x86_64__)
    __builtin_ia32_pause();
#endif
}

// Waits for about a millisecond at most, as long as a condition holds.
template <class F>
INLINE void spin_while(F holds) {
    for (int i = 0; i < SPINS && holds(); i++) pause_briefly();
    for (int i = 0; i < YIELDS && holds(); i++) sched_yield();
}

INLINE void run_shares(int first) {
    for (int share = first; share < pool.shares; share += pool.n_workers + 1) pool.phase(pool.context, share);
}

static void* work(void* argument) {
    Pool::Start start = *(Pool::Start*)argument;
    for (int seen = start.generation;; seen++) {
        spin_while([=] { return peek(&pool.generation) == seen; });
        if (peek(&pool.generation) == seen) {
            pthread_mutex_lock(pool.mutex);
            while (peek(&pool.generation) == seen) pthread_cond_wait(pool.wake, pool.mutex);
            pthread_mutex_unlock(pool.mutex);
        }
        run_shares(start.worker);
        if (__atomic_sub_fetch(&pool.left, 1, __ATOMIC_ACQ_REL)) continue;
        pthread_mutex_lock(pool.mutex);
        pthread_cond_broadcast(pool.done);
        pthread_mutex_unlock(pool.mutex);
    }
    return nullptr;
}

// Starts workers up to the wanted number, or as many as the system allows. After fork() a child has to start its own.
static void hire(int wanted) {
    if (pool.pid != getpid()) {
        pthread_mutex_init(pool.mutex, nullptr);
        pthread_cond_init(pool.wake, nullptr), pthread_cond_init(pool.done, nullptr);
        pool.n_workers = 0, pool.pid = getpid();
    }
    while (pool.n_workers < imin2(wanted, MAX_WORKERS)) {
        int next = pool.n_workers + 1;
        alignas(16) char thread[64];
        pool.starts[next] = {next, pool.generation};
        if (pthread_create(thread, nullptr, work, &pool.starts[next])) return;
        pool.n_workers = next;
    }
}

static void run_phase(int shares, void (*phase)(void*, int), void* context) {
    pool.shares = shares, pool.phase = phase, pool.context = context;
    hire(shares - 1);
    __atomic_store_n(&pool.left, pool.n_workers, __ATOMIC_RELEASE);
    pthread_mutex_lock(pool.mutex);
    __atomic_add_fetch(&pool.generation, 1, __ATOMIC_ACQ_REL);
    pthread_cond_broadcast(pool.wake);
    pthread_mutex_unlock(pool.mutex);
    run_shares(0);
    spin_while([] { return peek(&pool.left) != 0; });
    pthread_mutex_lock(pool.mutex);
    while (peek(&pool.left)) pthread_cond_wait(pool.done, pool.mutex);
    pthread_mutex_unlock(pool.mutex);
}

// Calls phase(share) for every share, sequentially if there is one share or another thread is using the pool.
template <class F>
INLINE void parallel(int shares, F phase) {
    auto call = [](void* f, int share) { (*(F*)f)(share); };
    if (shares > 1 && !__atomic_exchange_n(&pool.busy, 1, __ATOMIC_ACQUIRE)) {
        run_phase(shares, call, &phase);
        __atomic_store_n(&pool.busy, 0, __ATOMIC_RELEASE);
        return;
    }
    for (int share = 0; share < shares; share++) phase(share);
}
#else
template <class F>
INLINE void parallel(int shares, F phase) {
    for (int share = 0; share < shares; share++) phase(share);
}
#endif
