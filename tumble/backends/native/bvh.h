// A 16-wide bounding volume hierarchy of Gaussians in the object frame, and ray tracing through it.
//
// Gaussians are sorted by recursive bisection of space. Sixteen consecutive Gaussians are a leaf, sixteen consecutive
// leaves a node, and so on: child c of node i is node 16 i + c of the level below, so that no pointers are needed.
// A node holds the bounding boxes of its sixteen children and a cone around the normals of each; children whose normals
// all point along the ray are skipped as back-facing.
#pragma once
#include "project.h"

enum { WIDE = 16, LEVELS = 8, BUFFER = 128, MAX_NEAR = 256, FIELDS = 15 };

struct Leaf {
    float W[9][WIDE], extent[6][WIDE], mean[3][WIDE], opacity[WIDE];   // extent: matrix whose form is the squared reach
    int id[WIDE];
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

// Field j of the Gaussians [first, first + count) of an [n stride] array.
INLINE void put(float* p, int stride, int j, int first, int count, vf value) {
    for (int i = 0; i < count; i++) p[(i64)(first + i) * stride + j] = value[i];
}

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
        vf cut = 2.0f * vlog(vmax(gather1(t.opacity, first, count) * (1.0f / t.alpha_min), splat(1.0f)));
        cut = vmin(cut + 1e-4f, splat(t.sigmas * t.sigmas * 1.0001f));
        for (int i = 0, k = 0; i < 3; i++) {
            V3 side = row(R, i) * s;
            vf half = vsqrt(cut * dot(side, side)) + 1e-6f;
            for (int j = i; j < 3; j++, k++) put(fields, FIELDS, 9 + k, first, count, cut * dot(side, row(R, j) * s));
            put(t.boxes, 6, i, first, count, m[i] - half), put(t.boxes, 6, 3 + i, first, count, m[i] + half);
            put(t.normals, 3, i, first, count, R(i, 2));
            for (int j = 0; j < 3; j++) put(fields, FIELDS, 3 * i + j, first, count, R(j, i) * inv[i]);
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
        for (int c = 0; c < WIDE && l * WIDE + c < t.n; c++) {
            int g = t.order[l * WIDE + c];
            for (int j = 0; j < 9; j++) leaf.W[j][c] = fields[FIELDS * (i64)g + j];
            for (int j = 0; j < 6; j++) leaf.extent[j][c] = fields[FIELDS * (i64)g + 9 + j];
            for (int j = 0; j < 3; j++) leaf.mean[j][c] = t.means[3 * (i64)g + j];
            leaf.opacity[c] = t.opacity[g], leaf.id[c] = g;
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
        r.inv[a] = 1 / (d[a] < 0 ? fmin2(d[a], -1e-12f) : fmax2(d[a], 1e-12f)), r.o_inv[a] = o[a] * r.inv[a];
    }
    return r;
}

// Alphas of the Gaussians of a leaf on the ray (0 where not hit) and distances of their peaks.
INLINE vi met_gaussians(const Bvh& t, const Leaf& leaf, int c, const Ray& r, vf& alpha, vf& z) {
    vf p[3], Wd[3], Wp[3];
    for (int a = 0; a < 3; a++) p[a] = load(leaf.mean[a] + c) - r.o[a];
    for (int i = 0; i < 3; i++) {
        vf w0 = load(leaf.W[3 * i] + c), w1 = load(leaf.W[3 * i + 1] + c), w2 = load(leaf.W[3 * i + 2] + c);
        Wd[i] = w0 * r.d[0] + w1 * r.d[1] + w2 * r.d[2], Wp[i] = w0 * p[0] + w1 * p[1] + w2 * p[2];
    }
    vf along = Wp[0] * Wd[0] + Wp[1] * Wd[1] + Wp[2] * Wd[2];
    vi on = (along > 0.0f) & (Wd[2] <= 0.0f);
    if (!any(on)) return on;
    z = along / (Wd[0] * Wd[0] + Wd[1] * Wd[1] + Wd[2] * Wd[2]);
    vf x = z * Wd[0] - Wp[0], y = z * Wd[1] - Wp[1], w = z * Wd[2] - Wp[2], distance = x * x + y * y + w * w;
    on &= distance <= t.sigmas * t.sigmas;
    if (!any(on)) return on;
    alpha = load(leaf.opacity + c) * vexp(-0.5f * pick(on, distance, vf{}));
    on &= alpha >= t.alpha_min;
    alpha = keep(on, vmin(alpha, splat(t.alpha_max)));
    return on;
}

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
        if (any((height + vsqrt(vmax(form, vf{})) > 0.0f) & (load(leaf.opacity + c) > 0.0f))) return true;
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

// Children of a node that the ray may hit, one bit each.
INLINE u32 met_children(const Node& n, const Ray& r) {
    u32 met = 0;
    for (int c = 0; c < WIDE; c += LANES) met |= met_boxes(n, c, r) << c;
    return met;
}

// Calls visit(alpha, z, ids, on) for every group of Gaussians of a leaf with hits, until it returns false.
template <class F>
INLINE bool visit_leaf(const Bvh& t, int l, const Ray& ray, F visit) {
    const Leaf& leaf = t.leaves[l];
    for (int c = 0; c < WIDE; c += LANES) {
        vf alpha, z;
        vi on = met_gaussians(t, leaf, c, ray, alpha, z);
        if (any(on) && !visit(alpha, z, leaf.id + c, on)) return false;
    }
    return true;
}

// The same for all leaves, in ascending order; those of `near` if it is given.
template <class F>
INLINE void search(const Bvh& t, const Near* near, const Ray& ray, F visit) {
    if (near) {
        for (int c = 0; c < near->count; c += LANES)
            for (u32 met = met_boxes(*near, c, ray); met; met &= met - 1)
                if (!visit_leaf(t, near->leaf[c + __builtin_ctz(met)], ray, visit)) return;
        return;
    }
    struct Task {
        int level, node;
        u32 met;
    } stack[LEVELS];
    int top = 0, root = t.n_levels - 1;
    stack[0] = {root, 0, met_children(t.nodes[t.first_node[root]], ray)};
    while (top >= 0) {
        Task& task = stack[top];
        if (!task.met) {
            top--;
            continue;
        }
        int child = task.node * WIDE + __builtin_ctz(task.met), level = task.level;
        task.met &= task.met - 1;
        if (level) {
            u32 met = met_children(t.nodes[t.first_node[level - 1] + child], ray);
            if (met) stack[++top] = {level - 1, child, met};
            continue;
        }
        if (!visit_leaf(t, child, ray, visit)) return;
    }
}

INLINE float product(vf x) {
    float p[LANES];
    store(p, x);
    for (int half = LANES / 2; half; half /= 2)
        for (int i = 0; i < half; i++) p[i] *= p[i + half];
    return p[0];
}

INLINE bool is_visible(const Bvh& t, const Near* near, const Ray& ray) {
    float T = 1;
    search(t, near, ray, [&](vf alpha, vf, const int*, vi) { return (T *= product(1.0f - alpha)) >= t.visible; });
    return T >= t.visible;
}

// Hits of a ray.
struct Hits {
    float z[BUFFER + LANES], alpha[BUFFER];
    int id[BUFFER], order[BUFFER], count;

    // Sorts into `order`, nearest first: the position of a hit is the number of nearer hits.
    METHOD void sort() {
        int sum = 0;
        store(z + count, splat(2e30f));
        for (int i = 0; i < count; i++) {
            int place = 0;
            for (int c = 0; c < count; c += LANES) place += __builtin_popcount(bits(load(z + c) < z[i]));
            order[place] = i, sum += place;
        }
        if (sum != count * (count - 1) / 2) sort_duplicates();
    }

    // Orders hits of equal distance (exact duplicates) by id.
    __attribute__((noinline)) void sort_duplicates() {
        for (int i = 0; i < count; i++) {
            int place = 0;
            for (int j = 0; j < count; j++) place += z[j] < z[i] || (z[j] == z[i] && id[j] < id[i]);
            order[place] = i;
        }
    }

    // Keeps the nearer half; returns the index of the farthest hit kept.
    inline int halve() {
        float z_kept[BUFFER / 2], alpha_kept[BUFFER / 2];
        int id_kept[BUFFER / 2];
        sort();
        count = BUFFER / 2;
        for (int i = 0; i < count; i++)
            z_kept[i] = z[order[i]], alpha_kept[i] = alpha[order[i]], id_kept[i] = id[order[i]];
        for (int i = 0; i < count; i++) z[i] = z_kept[i], alpha[i] = alpha_kept[i], id[i] = id_kept[i];
        return count - 1;
    }
};

// Collects the hits behind (after_z, after_id). If the buffer is too small, only the nearest ones, and `all` is false.
static void collect(const Bvh& t, const Near* near, const Ray& ray, float after_z, int after_id, Hits& hits, bool& all) {
    float limit_z = 1e30f;
    int limit_id = 0;
    hits.count = 0, all = true;
    search(t, near, ray, [&](vf alpha, vf z, const int* id, vi on) {
        float alphas[LANES], depths[LANES];
        store(alphas, alpha), store(depths, z);
        on &= (z >= after_z) & (z <= limit_z);
        for (u32 b = bits(on); b; b &= b - 1) {
            int i = __builtin_ctz(b);
            if (depths[i] == after_z && id[i] <= after_id) continue;
            if (depths[i] == limit_z && id[i] > limit_id) continue;
            hits.z[hits.count] = depths[i], hits.alpha[hits.count] = alphas[i], hits.id[hits.count++] = id[i];
        }
        if (hits.count <= BUFFER - 2 * LANES) return true;
        int farthest = hits.halve();
        limit_z = hits.z[farthest], limit_id = hits.id[farthest], all = false;
        return true;
    });
    hits.sort();
}

// Blends the hits of a ray front to back; returns the dominant Gaussian.
static int trace_ray(const Bvh& t, const Near* near, const Ray& ray, const float* radiance, float* transmittance, float* out) {
    float T = 1, best = 0, sum[3] = {}, z = -1;
    int dominant = -1, id = 0;
    bool all = false;
    Hits hits;
    while (!all && T >= t.T_min) {
        collect(t, near, ray, z, id, hits, all);
        for (int place = 0; place < hits.count && T >= t.T_min; place++) {
            int i = hits.order[place];
            float w = T * hits.alpha[i];
            z = hits.z[i], id = hits.id[i];
            if (w > best) best = w, dominant = id;
            if (radiance)
                for (int ch = 0; ch < 3; ch++) sum[ch] += w * radiance[3 * (i64)id + ch];
            T -= w;
        }
    }
    float scale = T < t.T_min ? 1 / (1 - T) : 1;
    if (out)
        for (int ch = 0; ch < 3; ch++) out[ch] = sum[ch] * scale;
    if (transmittance) *transmittance = T < t.T_min ? 0 : T;
    return dominant;
}

enum { RAYS_AT_ONCE = 64 };

static void trace_share(const Rays& r, int share) {
    for (i64 start = (i64)share * RAYS_AT_ONCE; start < r.n_rays; start += (i64)r.threads * RAYS_AT_ONCE)
        for (i64 i = start; i < start + RAYS_AT_ONCE && i < r.n_rays; i++)
            r.hit[i] = trace_ray(*r.bvh, nullptr, ray_at(r.origins + 3 * i, r.directions + 3 * i),
                                 r.has_radiance ? r.radiance : nullptr, r.transmittance + i, r.out + 3 * i);
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
    for (i64 p = share; p < r.n_rays; p += r.threads)
        for (int j = 0; j < r.n_directions; j++) {
            const float* d = r.directions + 3 * j;
            bool blocked = above(r.normals + 3 * p, d) && !((u32)r.bits[p * r.words + j / 32] >> j % 32 & 1);
            int* hit = r.hit + p * r.n_directions + j;
            *hit = blocked ? trace_ray(*r.bvh, nullptr, ray_at(r.origins + 3 * p, d), nullptr, nullptr, nullptr) : -1;
        }
}
