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

// Jobs that may be pending in other threads; a further one waits for the oldest.
constexpr int64_t LATER = 4;

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

    // Works on the remaining parts and waits for those of others, meanwhile working on other jobs (`otherwise`).
    template <class Otherwise> void finish(const Otherwise& otherwise) {
        while (take()) {}
        for (int spins = 0; unfinished.load();)
            if (!otherwise()) spins++ < 2000 ? relax() : std::this_thread::yield();
    }
};

// Threads that wait for parts: awake for a moment, since a step has dozens of operations, then asleep. The caller takes
// parts too, so a thread without a core delays nothing. Threads without a part of an urgent operation work on pending
// jobs, in the order in which they came.
class Crew {
    static constexpr auto AWAKE = std::chrono::microseconds(100);

    std::mutex one_caller, one_leaver, lock;
    std::condition_variable work;
    std::atomic<int64_t> asleep{0}, oldest{0};
    Parts urgent, later[LATER];
    int64_t threads = 0;
    pid_t process = 0;

    bool take_later() {
        const int64_t first = oldest.load();
        for (int64_t i = 0; i < LATER; i++)
            if (later[(first + i) % LATER].take()) return true;
        return false;
    }

    bool has_parts() const {
        return urgent.any_left() || std::any_of(later, later + LATER, [](const Parts& parts) { return parts.any_left(); });
    }

    void wait() {
        const auto until = std::chrono::steady_clock::now() + AWAKE;
        while (std::chrono::steady_clock::now() < until)
            for (int i = 0; i < 32; i++) {
                if (has_parts()) return;
                relax();
            }
        std::unique_lock<std::mutex> held(lock);
        asleep.fetch_add(1);
        work.wait(held, [&] { return has_parts(); });
        asleep.fetch_sub(1);
    }

    [[noreturn]] void work_forever() {
        for (;;)
            if (!urgent.take() && !take_later()) wait();
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
        urgent.put(parts, std::cref(each));
        wake(parts - 1);
        urgent.finish([this] { return take_later(); });
    }

    // Hands each(part) for all parts, at most MOST, to other threads. Returns the job's number for `finish`.
    template <class Each> int64_t leave(int64_t parts, int64_t helpers, const Each& each) {
        const std::lock_guard<std::mutex> mine(one_leaver);
        const int64_t number = oldest.load();
        if (is_forked()) {
            for (int64_t part = 0; part < parts; part++) each(part);
            return number;
        }
        finish(number);
        later[number].put(parts, each);
        oldest.store((number + 1) % LATER);
        wake(helpers);
        return number;
    }

    // Waits for a pending job. In a forked process no other thread would finish its parts.
    void finish(int64_t number) {
        if (!is_forked()) later[number].finish([] { return false; });
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
    static int64_t leave(int64_t count, int64_t size, int64_t helpers, A... arguments) {
        return crew().leave((count + size - 1) / size, helpers, [=](int64_t part) {
            F(part * size, std::min(count, (part + 1) * size), arguments...);
        });
    }
    static void finish(int64_t number) { crew().finish(number); }
};

// Makes an operation of (begin, end, ...) callable for all parts between bounds (ops/build.call_in_parts).
#define IN_PARTS(NAME) extern "C" { void* NAME##_in_parts = reinterpret_cast<void*>(&InParts<&NAME>::run); }
// The same for one that other threads may run later (ops/build.leave_in_parts).
#define LATER_IN_PARTS(NAME)                                                                                           \
    extern "C" {                                                                                                       \
    void* NAME##_later = reinterpret_cast<void*>(&InParts<&NAME>::leave);                                              \
    void* NAME##_finish = reinterpret_cast<void*>(&InParts<&NAME>::finish);                                            \
    }
