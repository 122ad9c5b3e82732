// Parts of an operation, each by a thread. An operation writes the same bits for any number of parts.
#pragma once
#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <mutex>
#include <thread>
#include <unistd.h>

#if defined(__x86_64__) || defined(__i386__)
inline void relax() { __builtin_ia32_pause(); }
#else
inline void relax() { std::atomic_signal_fence(std::memory_order_seq_cst); }
#endif

// Number of the part that this thread works on.
inline thread_local int64_t this_part = 0;

// The parts of one job, taken first come, first served.
class Parts {
    static constexpr uint64_t ONE = 1; // a ticket: number of the job, its parts, the next of them
    std::atomic<uint64_t> ticket{0};
    std::atomic<int64_t> unfinished{0};
    std::function<void(int64_t)> job;

  public:
    static constexpr int64_t MOST = (1 << 16) - 1;

    bool any_left() const {
        const uint64_t now = ticket.load();
        return (now & MOST) < (now >> 16 & MOST);
    }

    // Works on one part, if any remains.
    bool take() {
        uint64_t now = ticket.load();
        while ((now & MOST) < (now >> 16 & MOST)) {
            if (!ticket.compare_exchange_weak(now, now + ONE)) continue;
            this_part = int64_t(now & MOST);
            job(this_part); // stays until the last part is finished
            unfinished.fetch_sub(1);
            return true;
        }
        return false;
    }

    // The next job; the one before is finished.
    void put(int64_t parts, std::function<void(int64_t)> each) {
        job = std::move(each);
        unfinished.store(parts);
        ticket.store(((ticket.load() >> 32) + 1) << 32 | uint64_t(parts) << 16);
    }

    // Works on the remaining parts and waits for those of others.
    void finish() {
        while (take()) {}
        for (int spins = 0; unfinished.load();) spins++ < 2000 ? relax() : std::this_thread::yield();
    }
};

// Threads that wait for parts: awake for a moment, since a step has dozens of operations, then asleep. The caller takes
// parts too, so a thread without a core delays nothing.
class Crew {
    static constexpr auto AWAKE = std::chrono::microseconds(100);

    std::mutex one_caller, lock;
    std::condition_variable work;
    std::atomic<int64_t> asleep{0};
    Parts job;
    int64_t threads = 0;
    pid_t process = 0;

    void wait() {
        const auto until = std::chrono::steady_clock::now() + AWAKE;
        while (std::chrono::steady_clock::now() < until)
            for (int i = 0; i < 32; i++) {
                if (job.any_left()) return;
                relax();
            }
        std::unique_lock<std::mutex> held(lock);
        asleep.fetch_add(1);
        work.wait(held, [&] { return job.any_left(); });
        asleep.fetch_sub(1);
    }

    [[noreturn]] void work_forever() {
        for (;;)
            if (!job.take()) wait();
    }

    bool is_forked() const { return process && process != getpid(); }

    void wake(int64_t helpers) {
        const std::lock_guard<std::mutex> held(lock);
        for (process = getpid(); threads < helpers; threads++) std::thread([this] { work_forever(); }).detach();
        if (asleep.load()) work.notify_all();
    }

  public:
    // each(part) for all parts. One caller at a time has the threads; a second caller, and a forked process, which has
    // none, works alone.
    template <class Each> void run(int64_t parts, const Each& each) {
        std::unique_lock<std::mutex> mine(one_caller, std::defer_lock);
        if (parts == 1 || parts > Parts::MOST || is_forked() || !mine.try_lock()) {
            for (this_part = 0; this_part < parts; this_part++) each(this_part);
            return;
        }
        job.put(parts, std::cref(each));
        wake(parts - 1);
        job.finish();
    }
};

inline Crew& crew() {
    static Crew* all = new Crew; // never destroyed: its threads run until the process ends
    return *all;
}

template <auto F> struct InParts;
template <class... A, void (*F)(int64_t, int64_t, A...)> struct InParts<F> {
    static void run(const int64_t* bounds, int64_t parts, A... arguments) {
        crew().run(parts, [&](int64_t part) { F(bounds[part], bounds[part + 1], arguments...); });
    }
};

// Makes an operation of (begin, end, ...) callable for all parts between bounds (ops/build.call_in_parts).
#define IN_PARTS(NAME) extern "C" { void* NAME##_in_parts = reinterpret_cast<void*>(&InParts<&NAME>::run); }
