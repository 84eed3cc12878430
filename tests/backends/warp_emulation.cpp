// The scheduler and the checks of `warp_emulation.h`. A launch stops with a message at
//   - a collective that lanes of its mask reach at different places, with different masks, or not at all,
//   - a shuffle from a lane that has ended or is not in the mask,
//   - an access outside the arrays of the launch, or to a stack of another lane,
//   - a race: two threads access the same four bytes, one of them writes, not both are atomic, and no barrier orders
//     them (`__syncwarp`, `__syncthreads`; shuffles and votes order nothing in memory),
//   - a failed assertion of Warp.
// The check for races keeps a cell of the last accesses for every four bytes of every array.

#include <algorithm>
#include <cstdarg>
#include <map>
#include <numeric>
#include <random>
#include <string>
#include <vector>

#include <setjmp.h>
#include <sys/mman.h>
#include <ucontext.h>

#include "warp_emulation.h"

// The writable data of the library: shared memory.
extern "C" __attribute__((visibility("hidden"))) char __ehdr_start[], _end[];

namespace emulation {

Indices indices;

namespace {

constexpr unsigned BLOCK = 256, WARPS = BLOCK / LANES;
constexpr size_t STACK = 1 << 17;

struct Lane {
    jmp_buf at;
    bool started, ended, waiting;
    Meeting meeting;
    unsigned mask, source;
    uint64_t number;
    const void* site[3];
};

// Who accessed four bytes, and how many barriers that thread had passed.
struct Visit {
    uint32_t thread;  // number + 1; 0 for nobody
    uint16_t warp_barriers, block_barriers;
};

struct Cell {
    Visit written, read, read_too;
    bool atomic, several;  // whether `written` was atomic, and followed atomic writes of other threads
};

struct Range {
    uintptr_t begin, end;
    std::string name;
    std::vector<Cell> cells;
};

enum Access { READ, WRITE, ATOMIC };
const char* const DOES[] = { "reads", "writes", "atomically changes" };

Lane lanes[BLOCK];
char* stacks;
unsigned current;
Visit self;
jmp_buf scheduler;
std::vector<unsigned> ready;
std::mt19937 dice;
uint16_t warp_barriers[WARPS], block_barriers;

std::map<uintptr_t, Range> ranges;  // by their ends
Range* last_range;
bool unknown_reads;

void (*kernel)(void* const*);
void* const* arguments;
const char* kernel_name;
char message[1000];

[[noreturn]] void failf(const char* format, ...) {
    int n = snprintf(message, sizeof message, "%s, thread %u of block %u ", kernel_name, current, indices.block.x);
    va_list list;
    va_start(list, format);
    vsnprintf(message + n, sizeof message - n, format, list);
    va_end(list);
    _longjmp(scheduler, 2);
}

void wait() {
    if (!_setjmp(lanes[current].at))
        _longjmp(scheduler, 1);
}

unsigned of_warp(unsigned warp, bool Lane::* flag) {
    unsigned bits = 0;
    for (unsigned i = 0; i < LANES; i++)
        bits |= unsigned(lanes[LANES * warp + i].*flag) << i;
    return bits;
}

void release(Lane& lane) {
    lane.waiting = false;
    ready.push_back(&lane - lanes);
}

void check_same(const Lane& a, const Lane& b) {
    const bool same_site = std::equal(a.site, a.site + 3, b.site);
    if (!same_site || a.meeting != b.meeting || a.mask != b.mask)
        failf(
            "and thread %u meet at different %s", unsigned(&b == &lanes[current] ? &a - lanes : &b - lanes),
            same_site ? "masks" : "places"
        );
}

void meet_block() {
    const Lane* first = nullptr;
    for (Lane& lane : lanes) {
        if (lane.ended)
            continue;
        if (!lane.waiting || lane.meeting != SYNC_BLOCK)
            return;
        first = first ? first : &lane;
        check_same(*first, lane);
    }
    block_barriers++;
    for (Lane& lane : lanes)
        if (!lane.ended)
            release(lane);
}

// Let the lanes in the mask of a waiting lane go on if all of them are there.
void meet_warp(unsigned warp, const Lane& lane) {
    Lane* all = lanes + LANES * warp;
    const unsigned alive = ~of_warp(warp, &Lane::ended), there = lane.mask & alive;
    if (there & ~of_warp(warp, &Lane::waiting))
        return;
    uint64_t numbers[LANES], votes = 0;
    for (unsigned i = 0; i < LANES; i++) {
        if (!(there >> i & 1))
            continue;
        check_same(lane, all[i]);
        numbers[i] = all[i].number;
        votes |= numbers[i] << i;
    }
    for (unsigned i = 0; i < LANES; i++) {
        if (!(there >> i & 1))
            continue;
        if (all[i].meeting == SHUFFLE && !(there >> all[i].source & 1))
            failf("takes part in a shuffle in which lane %u reads from lane %u, which is not there", i, all[i].source);
        all[i].number = all[i].meeting == SHUFFLE ? numbers[all[i].source] : votes;
        release(all[i]);
    }
    if (lane.meeting == SYNC_WARP && there == alive)
        warp_barriers[warp]++;
}

void end_of_lane() {
    lanes[current].ended = true;
    const unsigned warp = current / LANES;
    for (unsigned i = 0; i < LANES; i++) {
        const Lane& lane = lanes[LANES * warp + i];
        if (lane.waiting && lane.meeting != SYNC_BLOCK)
            meet_warp(warp, lane);
    }
    meet_block();
}

void run_lane() {
    for (;;) {
        kernel(arguments);
        end_of_lane();
        wait();
    }
}

void start(Lane& lane) {
    static ucontext_t here, there;
    lane.started = true;
    getcontext(&there);
    there.uc_stack.ss_sp = stacks + (&lane - lanes) * STACK;
    there.uc_stack.ss_size = STACK;
    makecontext(&there, run_lane, 0);
    swapcontext(&here, &there);
}

// Go on with a lane until it waits or ends. Returns whether it failed.
bool go_on(unsigned number) {
    current = number;
    indices.thread = { number, 0, 0 };
    self = { indices.block.x * BLOCK + number + 1, warp_barriers[number / LANES], block_barriers };
    const int why = _setjmp(scheduler);
    if (why)
        return why == 2;
    if (!lanes[number].started)
        start(lanes[number]);
    _longjmp(lanes[number].at, 1);
}

bool run_block() {
    block_barriers = 0;
    std::fill(warp_barriers, warp_barriers + WARPS, 0);
    ready.resize(BLOCK);
    std::iota(ready.begin(), ready.end(), 0u);
    for (Lane& lane : lanes)
        lane.ended = lane.waiting = false;
    while (!ready.empty()) {
        std::swap(ready[dice() % ready.size()], ready.back());
        const unsigned next = ready.back();
        ready.pop_back();
        if (go_on(next))
            return false;
    }
    for (Lane& lane : lanes)
        if (!lane.ended) {
            snprintf(
                message, sizeof message, "%s, block %u: thread %u waits for lanes that have gone elsewhere",
                kernel_name, indices.block.x, unsigned(&lane - lanes)
            );
            return false;
        }
    return true;
}

bool is_ordered(const Visit& before) {
    if (before.thread == 0 || before.thread == self.thread)
        return true;
    if ((before.thread - 1) / BLOCK != indices.block.x)
        return false;
    if (before.block_barriers < self.block_barriers)
        return true;
    const bool same_warp = (before.thread - 1) / LANES == (self.thread - 1) / LANES;
    return same_warp && before.warp_barriers < self.warp_barriers;
}

void check_race(const Range& range, Cell& cell, uintptr_t at, Access kind) {
    const bool both_atomic = kind == ATOMIC && cell.atomic;
    const bool same_interval = cell.written.block_barriers == self.block_barriers;
    const bool follows_written = is_ordered(cell.written) && !(cell.several && same_interval);
    const Visit* other = nullptr;
    if (!both_atomic && !follows_written)
        other = &cell.written;
    else if (kind != READ && !is_ordered(cell.read))
        other = &cell.read;
    else if (kind != READ && !is_ordered(cell.read_too))
        other = &cell.read_too;
    if (other) {
        const unsigned thread = other->thread - 1;
        const char* did = other != &cell.written ? "read" : cell.atomic ? "atomically changed" : "wrote";
        failf(
            "%s byte %zu of %s, which thread %u of block %u%s %s without a barrier between", DOES[kind],
            size_t(at - range.begin), range.name.c_str(), thread % BLOCK, thread / BLOCK,
            other == &cell.written && cell.several ? " (and others)" : "", did
        );
    }
    if (kind == READ) {
        (is_ordered(cell.read) ? cell.read : cell.read_too) = self;
        return;
    }
    cell.several = both_atomic && !follows_written;
    cell.atomic = kind == ATOMIC;
    cell.written = self;
}

Range* range_of(uintptr_t at) {
    if (last_range && at >= last_range->begin && at < last_range->end)
        return last_range;
    const auto found = ranges.upper_bound(at);
    if (found == ranges.end() || at < found->second.begin)
        return nullptr;
    return last_range = &found->second;
}

void access(const void* address, size_t bytes, Access kind) {
    const uintptr_t at = uintptr_t(address), own = uintptr_t(stacks) + current * STACK;
    if (at - own < STACK)
        return;
    if (at - uintptr_t(stacks) < BLOCK * STACK)
        failf("%s the stack of another lane", DOES[kind]);
    if (at - uintptr_t(&indices) < sizeof indices)
        return;
    Range* range = range_of(at);
    if (!range && kind == READ && unknown_reads)
        return;
    if (!range || at + bytes > range->end)
        failf("%s %zu bytes outside all arrays", DOES[kind], bytes);
    for (size_t i = (at - range->begin) / 4; i <= (at + bytes - 1 - range->begin) / 4; i++)
        check_race(*range, range->cells[i], range->begin + 4 * i, kind);
}

}  // namespace

uint64_t meet(Meeting meeting, unsigned mask, uint64_t number, unsigned source) {
    Lane& lane = lanes[current];
    const unsigned warp = current / LANES;
    lane.meeting = meeting;
    lane.mask = mask;
    lane.number = number;
    lane.source = source;
    lane.waiting = true;
    // The compiler joins no calls and keeps frame pointers, so that these identify the call.
    lane.site[0] = __builtin_return_address(0);
    lane.site[1] = __builtin_return_address(1);
    lane.site[2] = __builtin_return_address(2);
    if (!(mask >> current % LANES & 1))
        failf("is not in the mask with which it calls");
    if (meeting == SYNC_BLOCK)
        meet_block();
    else
        meet_warp(warp, lane);
    wait();
    return lane.number;
}

void before_atomic(const void* at, size_t bytes) {
    ready.push_back(current);
    wait();
    access(at, bytes, ATOMIC);
}

void fail(const char* what) { failf("%s", what); }

}  // namespace emulation

using namespace emulation;

extern "C" {

[[noreturn]] void emulated_assert_fail(const char* what, const char*, unsigned, const char*) noexcept {
    failf("finds that not %s", what);
}

// Say that a launch may access an array.
void emulation_allow(uintptr_t begin, size_t bytes, const char* name) {
    Range range { begin, begin + bytes, name, {} };
    // Arrays that overlap become one.
    for (auto found = ranges.upper_bound(begin); found != ranges.end() && found->second.begin < range.end;) {
        range.begin = std::min(range.begin, found->second.begin);
        range.end = std::max(range.end, found->second.end);
        range.name += "/" + found->second.name;
        found = ranges.erase(found);
    }
    ranges[range.end] = range;
}

// Run a kernel. Returns the empty string, or the error that stopped it.
const char* emulation_launch(
    const char* name, void (*invoke)(void* const*), void* const* packed, unsigned threads, int opaque, unsigned seed
) {
    if (!stacks)
        stacks = (char*)mmap(nullptr, BLOCK * STACK, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    kernel_name = name;
    kernel = invoke;
    arguments = packed;
    unknown_reads = opaque;
    dice.seed(seed);
    message[0] = 0;
    last_range = nullptr;
    indices.block_size = { BLOCK, 1, 1 };
    indices.grid_size = { (threads + BLOCK - 1) / BLOCK, 1, 1 };
    for (auto& [end, range] : ranges)
        range.cells.assign((range.end - range.begin + 3) / 4, Cell {});
    Range& shared = ranges[uintptr_t(_end)];
    shared = { uintptr_t(__ehdr_start), uintptr_t(_end), "shared memory", {} };
    std::vector<unsigned> blocks(indices.grid_size.x);
    std::iota(blocks.begin(), blocks.end(), 0u);
    std::shuffle(blocks.begin(), blocks.end(), dice);
    for (unsigned block : blocks) {
        indices.block = { block, 0, 0 };
        shared.cells.assign((shared.end - shared.begin + 3) / 4, Cell {});
        if (!run_block()) {
            for (Lane& lane : lanes)
                lane.started = false;
            break;
        }
    }
    ranges.clear();
    return message;
}

#define WATCH(size)                                                                                                    \
    void __tsan_read##size(void* at) { access(at, size, READ); }                                                       \
    void __tsan_write##size(void* at) { access(at, size, WRITE); }                                                     \
    void __tsan_unaligned_read##size(void* at) { access(at, size, READ); }                                             \
    void __tsan_unaligned_write##size(void* at) { access(at, size, WRITE); }
WATCH(1)
WATCH(2)
WATCH(4)
WATCH(8)
WATCH(16)
void __tsan_read_range(void* at, size_t bytes) { access(at, bytes, READ); }
void __tsan_write_range(void* at, size_t bytes) { access(at, bytes, WRITE); }
void __tsan_func_entry(void*) {}
void __tsan_func_exit() {}
void __tsan_init() {}
}
