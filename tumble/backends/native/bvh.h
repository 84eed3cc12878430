// A 16-wide bounding volume hierarchy of Gaussians in the object frame, and ray tracing through it.
//
// Gaussians are sorted by recursive bisection of space. Sixteen consecutive Gaussians are a leaf, sixteen consecutive
// leaves a node, and so on: child c of node i is node 16 i + c of the level below, so that no pointers are needed.
// A node holds the bounding boxes of its sixteen children and a cone around the normals of each; children whose normals
// all point along the ray are skipped as back-facing.
#pragma once
#include "project.h"

enum { WIDE = 16, LEVELS = 8, BUFFER = 128, MAX_NEAR = 256, FIELDS = 16 };

constexpr float NEVER = -1e30f;
typedef float v4 __attribute__((vector_size(16)));

struct Leaf {
    float W[9][WIDE], mean[3][WIDE], log_opacity[WIDE];   // logarithm to base 2, NEVER where there is no Gaussian
    int id[WIDE];
    float extent[6][WIDE];   // matrix whose form is the squared reach; rays do not need it
};
struct Node {
    float low[3][WIDE], high[3][WIDE], axis[3][WIDE], sine[WIDE];
};

struct Bvh {
    const float *means, *quats, *scales, *opacity;
    int n, n_leaves, n_levels, first_node[LEVELS];   // nodes of level l start there; the last level is the root
    float sigmas, alpha_max, alpha_min, T_min, visible;
    Leaf* leaves;
    Node* nodes;
    // Workspace of the build.
    float *boxes, *normals;   // low and high [n 6] and normals [n 3], later in tree order
    int* order;
};

struct Rays {
    const Bvh* bvh;
    const float *origins, *directions, *radiance, *normals;
    int n_rays, n_directions, words, threads, has_radiance;
    float *transmittance, *out;
    int *hit, *bits;
};

static void leaf_fields(Bvh& t, float* fields) {
    for (int first = 0; first < t.n; first += LANES) {
        int count = imin2(LANES, t.n - first);
        vf q[4];
        gather<4>(t.quats, first, count, q);
        vf length = 1.0f / vsqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
        for (int j = 0; j < 4; j++) q[j] *= length;
        M3 R = rotation(q);
        V3 s = gather3(t.scales, first, count), mu = gather3(t.means, first, count);
        vf inv[3] = {1.0f / s.x, 1.0f / s.y, 1.0f / s.z}, m[3] = {mu.x, mu.y, mu.z};
        vf opacity = gather1(t.opacity, first, count), cut = 2.0f * vlog(vmax(opacity * (1.0f / t.alpha_min), splat(1.0f)));
        scatter(fields, FIELDS, 15, first, count, 1.44269504f * vlog(vmax(opacity, splat(1e-30f))));
        cut = vmin(cut + 1e-4f, splat(t.sigmas * t.sigmas * 1.0001f));
        for (int i = 0, k = 0; i < 3; i++) {
            V3 side = row(R, i) * s;
            vf half = vsqrt(cut * dot(side, side)) + 1e-6f;
            for (int j = i; j < 3; j++, k++) scatter(fields, FIELDS, 9 + k, first, count, cut * dot(side, row(R, j) * s));
            scatter(t.boxes, 6, i, first, count, m[i] - half), scatter(t.boxes, 6, 3 + i, first, count, m[i] + half);
            scatter(t.normals, 3, i, first, count, R(i, 2));
            for (int j = 0; j < 3; j++) scatter(fields, FIELDS, 3 * i + j, first, count, R(j, i) * inv[i]);
        }
    }
}

// Quickselect: moves the Gaussians with the smallest coordinates along an axis to order[from, middle).
static void split_at(Bvh& t, int axis, int from, int middle, int to) {
    auto key = [&](int i) { return t.means[3 * (i64)t.order[i] + axis]; };
    auto swap = [&](int i, int j) {
        int other = t.order[i];
        t.order[i] = t.order[j], t.order[j] = other;
    };
    while (to - from > 1) {
        float a = key(from), b = key(from + (to - from) / 2), c = key(to - 1);
        float pivot = fmax2(fmin2(a, b), fmin2(fmax2(a, b), c));
        int i = from, j = to - 1;
        while (i <= j) {
            while (key(i) < pivot) i++;
            while (key(j) > pivot) j--;
            if (i <= j) swap(i++, j--);
        }
        if (middle <= j)
            to = j + 1;
        else if (middle >= i)
            from = i;
        else
            return;
    }
}

// Recursive bisection across the longest side at multiples of power-of-two numbers of leaves, so that 16^k consecutive
// Gaussians from a multiple of 16^k on are close together.
static void sort_by_halving(Bvh& t) {
    struct Range {
        int from, to;
    } stack[64];
    int top = 0;
    for (int i = 0; i < t.n; i++) t.order[i] = i;
    stack[0] = {0, t.n};
    while (top >= 0) {
        Range r = stack[top--];
        if (r.to - r.from <= WIDE) continue;
        float low[3] = {1e30f, 1e30f, 1e30f}, high[3] = {-1e30f, -1e30f, -1e30f};
        for (int i = r.from; i < r.to; i++)
            for (int a = 0; a < 3; a++) {
                float x = t.means[3 * (i64)t.order[i] + a];
                low[a] = fmin2(low[a], x), high[a] = fmax2(high[a], x);
            }
        int axis = 0, half = WIDE;
        for (int a = 1; a < 3; a++)
            if (high[a] - low[a] > high[axis] - low[axis]) axis = a;
        while (2 * half < r.to - r.from) half *= 2;
        split_at(t, axis, r.from, r.from + half, r.to);
        stack[++top] = {r.from, r.from + half}, stack[++top] = {r.from + half, r.to};
    }
}

// Computes child c of a node from the Gaussians [from, to) in sorted order.
static void enclose(const Bvh& t, Node& node, int c, int from, int to) {
    float axis[3] = {}, worst = 1, length = 0;
    for (int a = 0; a < 3; a++) node.low[a][c] = 1e30f, node.high[a][c] = -1e30f;
    for (int i = from; i < to; i++) {
        const float *box = t.boxes + 6 * (i64)t.order[i], *n = t.normals + 3 * (i64)t.order[i];
        for (int a = 0; a < 3; a++) {
            node.low[a][c] = fmin2(node.low[a][c], box[a]), node.high[a][c] = fmax2(node.high[a][c], box[3 + a]);
            axis[a] += n[a];
        }
    }
    for (int a = 0; a < 3; a++) length += axis[a] * axis[a];
    length = __builtin_sqrtf(length) + 1e-20f;
    for (int a = 0; a < 3; a++) node.axis[a][c] = axis[a] /= length;
    for (int i = from; i < to; i++) {
        const float* n = t.normals + 3 * (i64)t.order[i];
        worst = fmin2(worst, n[0] * axis[0] + n[1] * axis[1] + n[2] * axis[2]);
    }
    // A cone of more than a right angle always contains a normal that faces the ray.
    node.sine[c] = worst <= 0 ? 2 : __builtin_sqrtf(fmax2(1 - worst * worst, 0)) + 1e-3f;
    if (from >= to) node.sine[c] = -2;
}

static void fill_tree(Bvh& t, const float* fields) {
    for (int l = 0; l < t.n_leaves; l++) {
        Leaf& leaf = t.leaves[l];
        clear(&leaf, sizeof leaf);
        for (int c = 0; c < WIDE; c++) leaf.log_opacity[c] = NEVER;
        for (int c = 0; c < WIDE && l * WIDE + c < t.n; c++) {
            int g = t.order[l * WIDE + c];
            for (int j = 0; j < 9; j++) leaf.W[j][c] = fields[FIELDS * (i64)g + j];
            for (int j = 0; j < 6; j++) leaf.extent[j][c] = fields[FIELDS * (i64)g + 9 + j];
            for (int j = 0; j < 3; j++) leaf.mean[j][c] = t.means[3 * (i64)g + j];
            leaf.log_opacity[c] = fields[FIELDS * (i64)g + 15], leaf.id[c] = g;
        }
    }
    i64 reach = WIDE;   // Gaussians below a child
    int below = t.n_leaves;
    for (int level = 0; level < t.n_levels; level++, reach *= WIDE) {
        int count = imax2(1, (below + WIDE - 1) / WIDE);
        for (int i = 0; i < count; i++)
            for (int c = 0; c < WIDE; c++) {
                i64 from = (i64)(i * WIDE + c) * reach, to = from + reach;
                enclose(t, t.nodes[t.first_node[level] + i], c, from < t.n ? (int)from : t.n, to < t.n ? (int)to : t.n);
            }
        below = count;
    }
}

struct Ray {
    float o[3], d[3], inv[3], o_inv[3];
};
INLINE Ray ray_at(const float* o, const float* d) {
    Ray r;
    for (int a = 0; a < 3; a++) {
        r.o[a] = o[a], r.d[a] = d[a];
        r.inv[a] = 1 / __builtin_copysignf(fmax2(__builtin_fabsf(d[a]), 1e-12f), d[a]), r.o_inv[a] = o[a] * r.inv[a];
    }
    return r;
}

// Which Gaussians of a leaf the ray hits, the logarithms of their alphas to base 2, and the distances of their peaks.
INLINE vi met_gaussians(const Bvh& t, const Leaf& leaf, int c, const Ray& r, float log_alpha_min, vf& log_alpha, vf& z) {
    vf p[3], Wd[3], Wp[3];
    for (int a = 0; a < 3; a++) p[a] = load(leaf.mean[a] + c) - r.o[a];
    for (int i = 0; i < 3; i++) {
        vf w0 = load(leaf.W[3 * i] + c), w1 = load(leaf.W[3 * i + 1] + c), w2 = load(leaf.W[3 * i + 2] + c);
        Wd[i] = w0 * r.d[0] + w1 * r.d[1] + w2 * r.d[2], Wp[i] = w0 * p[0] + w1 * p[1] + w2 * p[2];
    }
    vf along = Wp[0] * Wd[0] + Wp[1] * Wd[1] + Wp[2] * Wd[2];
    vi on = (along > 0.0f) & (Wd[2] <= 0.0f);
    z = along * inverse(Wd[0] * Wd[0] + Wd[1] * Wd[1] + Wd[2] * Wd[2]);
    vf x = z * Wd[0] - Wp[0], y = z * Wd[1] - Wp[1], w = z * Wd[2] - Wp[2], distance = x * x + y * y + w * w;
    log_alpha = load(leaf.log_opacity + c) - 0.721347520f * distance;
    return on & (distance <= t.sigmas * t.sigmas) & (log_alpha >= log_alpha_min);
}
INLINE float log_alpha_min(const Bvh& t) { return 1.44269504f * vlog(splat(t.alpha_min))[0]; }

// Leaves that rays from one point into the half space above it may meet, in ascending order, in whole vectors.
struct Near {
    float low[3][MAX_NEAR], high[3][MAX_NEAR], axis[3][MAX_NEAR], sine[MAX_NEAR];
    int leaf[MAX_NEAR], count;
};

// Children of a node whose boxes reach into the half space above a point, one bit each.
INLINE u32 children_above(const Node& n, const float* o, const float* normal) {
    u32 met = 0;
    for (int c = 0; c < WIDE; c += LANES) {
        vf height = splat(1e-5f);   // rounding must not lose a child
        for (int a = 0; a < 3; a++)
            height += vmax((load(n.low[a] + c) - o[a]) * normal[a], (load(n.high[a] + c) - o[a]) * normal[a]);
        met |= bits((height > 0.0f) & (load(n.sine + c) > -2.0f)) << c;
    }
    return met;
}

// Whether a Gaussian of a leaf reaches into the half space above a point.
INLINE bool is_above(const Leaf& leaf, const float* o, const float* n) {
    for (int c = 0; c < WIDE; c += LANES) {
        vf height = splat(1e-5f), form = {};
        for (int a = 0, k = 0; a < 3; a++) {
            height += (load(leaf.mean[a] + c) - o[a]) * n[a];
            for (int b = a; b < 3; b++, k++) form += load(leaf.extent[k] + c) * (n[a] * n[b] * (a == b ? 1 : 2));
        }
        if (any((height + vsqrt(vmax(form, vf{})) > 0.0f) & (load(leaf.log_opacity + c) > NEVER))) return true;
    }
    return false;
}

// Collects the leaves above a point; false if there are so many that the tree is faster.
static bool collect_near(const Bvh& t, const float* o, const float* normal, Near& near) {
    struct Task {
        int level, node;
        u32 met;
    } stack[LEVELS];
    int top = 0, root = t.n_levels - 1;
    stack[0] = {root, 0, children_above(t.nodes[t.first_node[root]], o, normal)};
    near.count = 0;
    while (top >= 0) {
        Task& task = stack[top];
        if (!task.met) {
            top--;
            continue;
        }
        int c = __builtin_ctz(task.met), child = task.node * WIDE + c, level = task.level;
        task.met &= task.met - 1;
        if (level) {
            stack[++top] = {level - 1, child, children_above(t.nodes[t.first_node[level - 1] + child], o, normal)};
            continue;
        }
        if (!is_above(t.leaves[child], o, normal)) continue;
        if (near.count == MAX_NEAR) return false;
        const Node& n = t.nodes[t.first_node[0] + task.node];
        int to = near.count++;
        for (int a = 0; a < 3; a++)
            near.low[a][to] = n.low[a][c], near.high[a][to] = n.high[a][c], near.axis[a][to] = n.axis[a][c];
        near.sine[to] = n.sine[c], near.leaf[to] = child;
    }
    for (int i = near.count; i < (near.count + LANES - 1) / LANES * LANES; i++) {   // never met
        for (int a = 0; a < 3; a++) near.low[a][i] = near.high[a][i] = near.axis[a][i] = 0;
        near.sine[i] = -2;
    }
    return true;
}

// Whether the ray may hit the boxes from c on.
template <class Boxes>
INLINE u32 met_boxes(const Boxes& n, int c, const Ray& r) {
    vf near = splat(0.0f), far = splat(1e30f);
    for (int a = 0; a < 3; a++) {
        vf t0 = load(n.low[a] + c) * r.inv[a] - r.o_inv[a], t1 = load(n.high[a] + c) * r.inv[a] - r.o_inv[a];
        near = vmax(near, vmin(t0, t1)), far = vmin(far, vmax(t0, t1));
    }
    vf along = load(n.axis[0] + c) * r.d[0] + load(n.axis[1] + c) * r.d[1] + load(n.axis[2] + c) * r.d[2];
    return bits((near <= far) & (along <= load(n.sine + c)));
}

// Calls visit(leaves, met) for groups of leaves of which a ray may hit those whose bits are set in `met`, in ascending order,
// until it returns false; for those of `near` only if it is given.
template <class F>
INLINE void search(const Bvh& t, const Near* near, const Ray& ray, F visit) {
    if (near) {
        for (int c = 0; c < near->count; c += LANES)
            if (!visit((vi)load((const float*)near->leaf + c), met_boxes(*near, c, ray))) return;
        return;
    }
    struct Task {
        int level, node;
        u32 met;
    } stack[LEVELS];
    auto met_children = [&](int level, int node) {
        u32 met = 0;
        for (int c = 0; c < WIDE; c += LANES) met |= met_boxes(t.nodes[t.first_node[level] + node], c, ray) << c;
        return met;
    };
    int top = 0;
    stack[0] = {t.n_levels - 1, 0, met_children(t.n_levels - 1, 0)};
    while (top >= 0) {
        Task& task = stack[top];
        if (task.level == 1) {
            // Without waiting for the result of a box test before the next one.
            for (u32 met = task.met; met; met &= met - 1) {
                int node = task.node * WIDE + __builtin_ctz(met);
                for (int c = 0; c < WIDE; c += LANES)
                    if (!visit(lane_index() + (node * WIDE + c), met_boxes(t.nodes[node], c, ray))) return;
            }
            top--;
        } else if (task.met) {
            int child = task.node * WIDE + __builtin_ctz(task.met), level = task.level - 1;
            task.met &= task.met - 1;
            stack[++top] = {level, child, met_children(level, child)};
        } else {
            top--;
        }
    }
}

INLINE bool is_visible(const Bvh& t, const Near* near, const Ray& ray) {
    float T = 1, least = log_alpha_min(t);
    search(t, near, ray, [&](vi leaves, u32 met) {
        for (; met; met &= met - 1)
            for (int leaf = leaves[__builtin_ctz(met)], c = 0; c < WIDE; c += LANES) {
                vf log_alpha, z;
                vi on = met_gaussians(t, t.leaves[leaf], c, ray, least, log_alpha, z);
                if (!any(on)) continue;
                T *= product_of(1.0f - keep(on, vmin(vexp2(keep(on, log_alpha)), splat(t.alpha_max))));
                if (T < t.visible) return false;
            }
        return true;
    });
    return T >= t.visible;
}

// Hits of a ray, in any order.
struct Hits {
    float z[BUFFER + LANES], log_alpha[BUFFER + LANES];
    int id[BUFFER + LANES], count;

    METHOD bool is_behind(int i, float z_i, int id_i) const { return z[i] > z_i || (z[i] == z_i && id[i] > id_i); }

    // Sorts indices, nearest first, hits at the same distance by id: the place of a hit is the number of nearer ones.
    __attribute__((noinline)) void sort(int* order) {
        for (int i = 0; i < count; i++) {
            int place = 0;
            for (int j = 0; j < count; j++) place += is_behind(i, z[j], id[j]);
            order[place] = i;
        }
    }

    // Keeps the nearer half; returns the index of the farthest hit kept.
    inline int halve() {
        float z_kept[BUFFER / 2], alpha_kept[BUFFER / 2];
        int id_kept[BUFFER / 2], order[BUFFER];
        sort(order);
        count = BUFFER / 2;
        for (int i = 0; i < count; i++)
            z_kept[i] = z[order[i]], alpha_kept[i] = log_alpha[order[i]], id_kept[i] = id[order[i]];
        for (int i = 0; i < count; i++) z[i] = z_kept[i], log_alpha[i] = alpha_kept[i], id[i] = id_kept[i];
        return count - 1;
    }

    // Computes the transmittances `through` the hits, and `before` them as T times the product over all nearer hits. No sorting is needed unless two hits are at
    // the same distance (exact duplicates), which the number of pairs in order reveals.
    METHOD void attenuate(float T, float alpha_max, float* through, float* before) {
        vi nearer = {};
        store(z + count, splat(2e30f)), store(log_alpha + count, splat(-100.0f)), store((float*)id + count, vf{});
        for (int c = 0; c <= count; c += LANES)
            store(through + c, 1.0f - vmin(vexp2(load(log_alpha + c)), splat(alpha_max)));
        for (int c = 0; c < count; c += LANES) {
            vf even = splat(T), odd = splat(1.0f), at = load(z + c);
            for (int j = 0; j < count; j += 2) {
                vi in_front = at > z[j], next = at > z[j + 1];
                even = in_front ? even * through[j] : even, odd = next ? odd * through[j + 1] : odd;
                nearer = in_front ? nearer + 1 : nearer, nearer = next ? nearer + 1 : nearer;
            }
            store(before + c, even * odd);
        }
        int pairs = 0, padding = (LANES - count % LANES) % LANES;
        for (int l = 0; l < LANES; l++) pairs += nearer[l];
        if (pairs == count * (count - 1) / 2 + count * padding) return;
        int order[BUFFER];
        sort(order);
        for (int place = 0; place < count; place++) before[order[place]] = T, T *= through[order[place]];
    }
};

// A ray on its way through the tree. Rays are traced a few at a time, step by step, because the steps of one ray wait for
// each other.
struct alignas(64) Traced {
    enum { WAITING = 64 };
    Hits hits;
    Ray ray;
    int waiting[WAITING + LANES], n_waiting;   // leaves that the ray may hit and that have not been searched yet
    // Hits in front of `after` have been blended. If there are too many others, `hits` has those up to `limit` only.
    float after_z, limit_z;
    int after_id, limit_id;
    bool all;
    // Results: blended radiance, transmittance, and the dominant Gaussian with its weight.
    float sum[3], T, best;
    int dominant;

    METHOD void start(const Ray& r) {
        ray = r, after_z = -1, after_id = 0, T = 1, best = 0, dominant = -1;
        for (int ch = 0; ch < 3; ch++) sum[ch] = 0;
    }

    METHOD void search_leaf(const Bvh& t, const Leaf& leaf, int c, float least) {
        vf log_alpha, z;
        vi on = met_gaussians(t, leaf, c, ray, least, log_alpha, z), id = (vi)load((const float*)leaf.id + c);
        if (after_z >= 0) on &= (z > after_z) | ((z == after_z) & (id > after_id));
        if (!all) on &= (z < limit_z) | ((z == limit_z) & (id <= limit_id));
        u32 lanes = bits(on);
        pack(hits.z + hits.count, lanes, z), pack(hits.log_alpha + hits.count, lanes, log_alpha);
        pack((float*)hits.id + hits.count, lanes, (vf)id);
        hits.count += __builtin_popcount(lanes);
        if (hits.count <= BUFFER - LANES) return;
        int farthest = hits.halve();
        limit_z = hits.z[farthest], limit_id = hits.id[farthest], all = false;
    }
    METHOD void search_waiting(const Bvh& t) {
        float least = log_alpha_min(t);
        for (int i = 0; i < n_waiting; i++)
            for (int c = 0; c < WIDE; c += LANES) search_leaf(t, t.leaves[waiting[i]], c, least);
        n_waiting = 0;
    }

    // Finds the leaves that the ray may hit; of many, the first ones are searched already.
    METHOD void find(const Bvh& t, const Near* near) {
        hits.count = n_waiting = 0, all = true, limit_z = 1e30f, limit_id = 0;
        search(t, near, ray, [&](vi leaves, u32 met) {
            pack((float*)waiting + n_waiting, met, (vf)leaves);
            n_waiting += __builtin_popcount(met);
            if (n_waiting > WAITING - LANES) search_waiting(t);
            return true;
        });
    }

    // Blends the collected hits front to back.
    METHOD void blend(const Bvh& t, const float* radiance) {
        float through_hit[BUFFER + LANES], before_hit[BUFFER + LANES];
        hits.attenuate(T, t.alpha_max, through_hit, before_hit);
        vf rest = splat(T), largest = {};
        vi of_largest = {};
        float w[BUFFER + LANES];
        for (int c = 0; c < hits.count; c += LANES) {
            vf before = load(before_hit + c), after = before * load(through_hit + c);
            vi blended = before >= t.T_min;
            vf weight = keep(blended, before - after);
            store(w + c, weight), rest = vmin(rest, pick(blended, after, rest));
            vi better = weight > largest;
            largest = pick(better, weight, largest);
            of_largest = better ? (vi)load((const float*)hits.id + c) : of_largest;
        }
        T = -largest_of(-rest);
        float weight = largest_of(largest);
        if (weight > best) best = weight, dominant = of_largest[__builtin_ctz(bits(largest == weight))];
        v4 even = {}, odd = {};
        for (int i = 0; radiance && i < hits.count; i += 2) {
            const float *a = radiance + 3 * (i64)hits.id[i], *b = radiance + 3 * (i64)hits.id[i + 1];
            even += w[i] * v4{a[0], a[1], a[2], 0}, odd += w[i + 1] * v4{b[0], b[1], b[2], 0};
        }
        for (int ch = 0; ch < 3; ch++) sum[ch] += even[ch] + odd[ch];
    }

    // Traces what a full buffer left for later, and normalises the result.
    METHOD void finish(const Bvh& t, const Near* near, const float* radiance) {
        while (!all && T >= t.T_min) {
            for (int i = 0; i < hits.count; i++)
                if (hits.is_behind(i, after_z, after_id)) after_z = hits.z[i], after_id = hits.id[i];
            find(t, near), search_waiting(t), blend(t, radiance);
        }
        if (T >= t.T_min) return;
        for (int ch = 0; ch < 3; ch++) sum[ch] /= 1 - T;
        T = 0;
    }
};

// Calls done(i, result) for n rays ray_of(i), blended front to back.
template <class RayOf, class Done>
INLINE void trace_rays(const Bvh& t, const Near* near, const float* radiance, int n, RayOf ray_of, Done done) {
    enum { AT_ONCE = 8 };
    Traced rays[AT_ONCE];
    for (int first = 0; first < n; first += AT_ONCE) {
        int count = imin2(AT_ONCE, n - first);
        for (int i = 0; i < count; i++) rays[i].start(ray_of(first + i)), rays[i].find(t, near);
        for (int i = 0; i < count; i++) rays[i].search_waiting(t);
        for (int i = 0; i < count; i++) rays[i].blend(t, radiance);
        for (int i = 0; i < count; i++) rays[i].finish(t, near, radiance), done(first + i, rays[i]);
    }
}

enum { RAYS_AT_ONCE = 64 };

static void trace_share(const Rays& r, int share) {
    for (i64 start = (i64)share * RAYS_AT_ONCE; start < r.n_rays; start += (i64)r.threads * RAYS_AT_ONCE) {
        int count = (int)(r.n_rays - start < RAYS_AT_ONCE ? r.n_rays - start : RAYS_AT_ONCE);
        trace_rays(
            *r.bvh, nullptr, r.has_radiance ? r.radiance : nullptr, count,
            [&](int i) { return ray_at(r.origins + 3 * (start + i), r.directions + 3 * (start + i)); },
            [&](int i, const Traced& ray) {
                r.hit[start + i] = ray.dominant, r.transmittance[start + i] = ray.T;
                for (int ch = 0; ch < 3; ch++) r.out[3 * (start + i) + ch] = ray.sum[ch];
            });
    }
}

INLINE bool above(const float* n, const float* d) { return n[0] * d[0] + n[1] * d[1] + n[2] * d[2] > 0; }

static void visible_share(const Rays& r, int share) {
    Near buffer;
    for (i64 p = share; p < r.n_rays; p += r.threads) {
        int* words = r.bits + p * r.words;
        const Near* near = collect_near(*r.bvh, r.origins + 3 * p, r.normals + 3 * p, buffer) ? &buffer : nullptr;
        clear(words, (i64)4 * r.words);
        for (int j = 0; j < r.n_directions; j++) {
            const float* d = r.directions + 3 * j;
            if (above(r.normals + 3 * p, d) && is_visible(*r.bvh, near, ray_at(r.origins + 3 * p, d)))
                words[j / 32] |= (int)(1u << j % 32);
        }
    }
}

static void blockers_share(const Rays& r, int share) {
    for (i64 p = share; p < r.n_rays; p += r.threads) {
        int blocked[64], count = 0;
        auto trace = [&] {
            trace_rays(
                *r.bvh, nullptr, nullptr, count,
                [&](int i) { return ray_at(r.origins + 3 * p, r.directions + 3 * blocked[i]); },
                [&](int i, const Traced& ray) { r.hit[p * r.n_directions + blocked[i]] = ray.dominant; });
            count = 0;
        };
        for (int j = 0; j < r.n_directions; j++) {
            bool visible = (u32)r.bits[p * r.words + j / 32] >> j % 32 & 1;
            r.hit[p * r.n_directions + j] = -1;
            if (above(r.normals + 3 * p, r.directions + 3 * j) && !visible) blocked[count++] = j;
            if (count == 64) trace();
        }
        trace();
    }
}
