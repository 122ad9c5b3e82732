// Parts of an operation, each by a thread. Whatever a part is, an operation writes the same bits for any number of them.
#pragma once
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
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

// Threads that wait for parts: awake for a moment, since a step has dozens of operations, then asleep. Whoever is there
// first takes the next part, also the caller, so nobody waits for a thread that has no core.
class Crew {
    using Job = void (*)(const void*, int64_t);
    static constexpr auto AWAKE = std::chrono::microseconds(100);
    static constexpr uint64_t ONE = 1, MOST = (1 << 16) - 1; // a ticket: number of the job, its parts, the next of them

    std::mutex one_caller, lock;
    std::condition_variable work;
    std::atomic<uint64_t> ticket{0};
    std::atomic<int64_t> unfinished{0}, asleep{0};
    Job job = nullptr;
    const void* what = nullptr;
    int64_t threads = 0;
    pid_t process = 0;

    static bool has_parts(uint64_t now) { return (now & MOST) < (now >> 16 & MOST); }

    // Works on one part, if there is one.
    bool take() {
        uint64_t now = ticket.load();
        while (has_parts(now)) {
            if (!ticket.compare_exchange_weak(now, now + ONE)) continue;
            this_part = int64_t(now & MOST);
            job(what, this_part); // stays until the last part is finished
            unfinished.fetch_sub(1);
            return true;
        }
        return false;
    }

    void wait() {
        const auto until = std::chrono::steady_clock::now() + AWAKE;
        while (std::chrono::steady_clock::now() < until)
            for (int i = 0; i < 32; i++) {
                if (has_parts(ticket.load(std::memory_order_relaxed))) return;
                relax();
            }
        std::unique_lock<std::mutex> held(lock);
        asleep.fetch_add(1);
        work.wait(held, [&] { return has_parts(ticket.load()); });
        asleep.fetch_sub(1);
    }

    [[noreturn]] void live() {
        for (;;)
            if (!take()) wait();
    }

  public:
    // each(part) for all parts. One caller at a time has the threads; another, and a process that was forked and has
    // none, works alone.
    template <class Each> void run(int64_t parts, const Each& each) {
        std::unique_lock<std::mutex> mine(one_caller, std::defer_lock);
        const bool alone = parts == 1 || parts > int64_t(MOST) || (process && process != getpid()) || !mine.try_lock();
        if (alone) {
            for (this_part = 0; this_part < parts; this_part++) each(this_part);
            return;
        }
        for (process = getpid(); threads < parts - 1; threads++) std::thread([this] { live(); }).detach();
        job = [](const void* each, int64_t part) { (*static_cast<const Each*>(each))(part); };
        what = &each;
        unfinished.store(parts);
        ticket.store(((ticket.load() >> 32) + 1) << 32 | uint64_t(parts) << 16);
        if (asleep.load()) {
            const std::lock_guard<std::mutex> held(lock);
            work.notify_all();
        }
        while (take()) {}
        for (int spins = 0; unfinished.load(); spins++) spins < 2000 ? relax() : std::this_thread::yield();
    }
};

inline Crew& crew() {
    static Crew* all = new Crew; // never destroyed: its threads live as long as the process
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
