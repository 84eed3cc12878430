// A 16-wide tree over Gaussians in the object frame, and the rays that search it.
//
// Gaussians are sorted along a space-filling curve; sixteen in a row are a leaf, sixteen leaves in a row a node, and so
// on: child c of node i is node 16 i + c of the level below, so the tree holds no pointers. A node knows the boxes of its
// sixteen children and a cone around the normals in each: a child whose every normal faces along the ray is passed by.
#pragma once
#include "project.h"

enum { WIDE = 16, LEVELS = 8, BUFFER = 128 };

struct Leaf {
    float W[9][WIDE], mean[3][WIDE], opacity[WIDE];
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
    u32* keys;
    int *order, *order_2;
};

struct Rays {
    const Bvh* bvh;
    const float *origins, *directions, *radiance, *normals;
    int n_rays, n_directions, words, threads, has_radiance;
    float *transmittance, *out;
    int *hit, *bits;
};

// Ten bits, two gaps after each.
INLINE u32 spread(u32 x) {
    x = (x | x << 16) & 0x30000ff, x = (x | x << 8) & 0x300f00f;
    x = (x | x << 4) & 0x30c30c3;
    return (x | x << 2) & 0x9249249;
}

static void leaf_fields(Bvh& t, float* W) {
    for (int first = 0; first < t.n; first += LANES) {
        int count = imin2(LANES, t.n - first);
        vf q[4];
        for (int j = 0; j < 4; j++) q[j] = gather(t.quats, 4, j, first, count);
        vf length = 1.0f / vsqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
        for (int j = 0; j < 4; j++) q[j] *= length;
        M3 R = rotation(q);
        V3 s = gather3(t.scales, first, count), mu = gather3(t.means, first, count);
        vf inv[3] = {1.0f / s.x, 1.0f / s.y, 1.0f / s.z}, m[3] = {mu.x, mu.y, mu.z};
        vf cut = 2.0f * vlog(vmax(gather(t.opacity, 1, 0, first, count) * (1.0f / t.alpha_min), splat(1.0f)));
        cut = vmin(cut + 1e-4f, splat(t.sigmas * t.sigmas * 1.0001f));
        for (int i = 0; i < 3; i++) {
            V3 side = row(R, i) * s;
            vf half = vsqrt(cut * dot(side, side)) + 1e-6f;
            scatter(t.boxes, 6, i, first, count, m[i] - half), scatter(t.boxes, 6, 3 + i, first, count, m[i] + half);
            scatter(t.normals, 3, i, first, count, R(i, 2));
            for (int j = 0; j < 3; j++) scatter(W, 9, 3 * i + j, first, count, R(j, i) * inv[i]);
        }
    }
}

static void sort_along_curve(Bvh& t) {
    float low[3] = {1e30f, 1e30f, 1e30f}, high[3] = {-1e30f, -1e30f, -1e30f};
    for (int i = 0; i < t.n; i++)
        for (int a = 0; a < 3; a++)
            low[a] = fmin2(low[a], t.means[3 * i + a]), high[a] = fmax2(high[a], t.means[3 * i + a]);
    float side = 1e-20f;
    for (int a = 0; a < 3; a++) side = fmax2(side, high[a] - low[a]);
    for (int i = 0; i < t.n; i++) {
        u32 x[3];
        for (int a = 0; a < 3; a++) x[a] = (u32)fmin2((t.means[3 * i + a] - low[a]) / side * 1023, 1023);
        t.keys[i] = spread(x[0]) << 2 | spread(x[1]) << 1 | spread(x[2]), t.order[i] = i;
    }
    int *from = t.order, *to = t.order_2;
    for (int pass = 0; pass < 3; pass++) {
        int histogram[DIGIT], start = 0;
        clear(histogram, sizeof histogram);
        for (int i = 0; i < t.n; i++) histogram[t.keys[i] >> 11 * pass & 2047]++;
        for (int d = 0; d < DIGIT; d++) {
            int count = histogram[d];
            histogram[d] = start, start += count;
        }
        for (int i = 0; i < t.n; i++) to[histogram[t.keys[from[i]] >> 11 * pass & 2047]++] = from[i];
        int* other = from;
        from = to, to = other;
    }
    t.order = from, t.order_2 = to;
}

// Child c of a node from the Gaussians [from, to) of the sorted order.
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
    // Past a right angle there is always a normal that faces the ray.
    node.sine[c] = worst <= 0 ? 2 : __builtin_sqrtf(fmax2(1 - worst * worst, 0)) + 1e-3f;
    if (from >= to) node.sine[c] = -2;
}

static void fill_tree(Bvh& t, const float* W) {
    for (int l = 0; l < t.n_leaves; l++) {
        Leaf& leaf = t.leaves[l];
        clear(&leaf, sizeof leaf);
        for (int c = 0; c < WIDE && l * WIDE + c < t.n; c++) {
            int g = t.order[l * WIDE + c];
            for (int j = 0; j < 9; j++) leaf.W[j][c] = W[9 * (i64)g + j];
            for (int j = 0; j < 3; j++) leaf.mean[j][c] = t.means[3 * (i64)g + j];
            leaf.opacity[c] = t.opacity[g], leaf.id[c] = g;
        }
    }
    i64 reach = WIDE;   // Gaussians below a child
    int below = t.n_leaves;
    for (int level = 0; level < t.n_levels; level++, reach *= WIDE) {
        int count = (below + WIDE - 1) / WIDE;
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

// Children of a node the ray may meet, one bit each.
INLINE u32 met_children(const Node& n, const Ray& r) {
    u32 met = 0;
    for (int c = 0; c < WIDE; c += LANES) {
        vf near = splat(0.0f), far = splat(1e30f);
        for (int a = 0; a < 3; a++) {
            vf t0 = load(n.low[a] + c) * r.inv[a] - r.o_inv[a], t1 = load(n.high[a] + c) * r.inv[a] - r.o_inv[a];
            near = vmax(near, vmin(t0, t1)), far = vmin(far, vmax(t0, t1));
        }
        vf along = load(n.axis[0] + c) * r.d[0] + load(n.axis[1] + c) * r.d[1] + load(n.axis[2] + c) * r.d[2];
        met |= bits((near <= far) & (along <= load(n.sine + c))) << c;
    }
    return met;
}

// Alphas of a leaf's Gaussians on the ray (0 where not met) and the distances of their peaks.
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

// Calls visit(alpha, z, ids, on) for every group of Gaussians the ray meets, in no order, until it returns false.
template <class F>
INLINE void search(const Bvh& t, const Ray& ray, F visit) {
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
        const Leaf& leaf = t.leaves[child];
        for (int c = 0; c < WIDE; c += LANES) {
            vf alpha, z;
            vi on = met_gaussians(t, leaf, c, ray, alpha, z);
            if (any(on) && !visit(alpha, z, leaf.id + c, on)) return;
        }
    }
}

INLINE float product(vf x) {
    float p[LANES];
    store(p, x);
    for (int half = LANES / 2; half; half /= 2)
        for (int i = 0; i < half; i++) p[i] *= p[i + half];
    return p[0];
}

INLINE bool is_visible(const Bvh& t, const Ray& ray) {
    float T = 1;
    search(t, ray, [&](vf alpha, vf, const int*, vi) { return (T *= product(1.0f - alpha)) >= t.visible; });
    return T >= t.visible;
}

struct Hit {
    float z, alpha;
    int id;
};
INLINE bool before(const Hit& a, const Hit& b) { return a.z < b.z || (a.z == b.z && a.id < b.id); }

// The nearest hits behind `after`, sorted, at most BUFFER - LANES; false in `all` if there are more.
static int nearest_hits(const Bvh& t, const Ray& ray, const Hit& after, Hit* hits, bool& all) {
    int count = 0;
    Hit last = {1e30f, 0, 0};
    all = true;
    auto sort = [&] {
        for (int i = 1; i < count; i++) {
            Hit h = hits[i];
            int j = i;
            for (; j > 0 && before(h, hits[j - 1]); j--) hits[j] = hits[j - 1];
            hits[j] = h;
        }
    };
    search(t, ray, [&](vf alpha, vf z, const int* id, vi on) {
        float alphas[LANES], depths[LANES];
        store(alphas, alpha), store(depths, z);
        for (u32 b = bits(on); b; b &= b - 1) {
            int i = __builtin_ctz(b);
            Hit h = {depths[i], alphas[i], id[i]};
            if (before(after, h) && before(h, last)) hits[count++] = h;
        }
        if (count > BUFFER - LANES) {
            sort(), all = false;
            count = BUFFER / 2, last = hits[count - 1];
        }
        return true;
    });
    sort();
    return count;
}

// Front to back along a ray; returns the dominant Gaussian.
static int trace_ray(const Bvh& t, const Ray& ray, const float* radiance, float* transmittance, float* out) {
    float T = 1, best = 0, sum[3] = {};
    int dominant = -1;
    bool all = false;
    Hit hits[BUFFER], after = {-1, 0, 0};
    while (!all && T >= t.T_min) {
        int count = nearest_hits(t, ray, after, hits, all);
        for (int i = 0; i < count && T >= t.T_min; i++) {
            float w = T * hits[i].alpha;
            if (w > best) best = w, dominant = hits[i].id;
            if (radiance)
                for (int ch = 0; ch < 3; ch++) sum[ch] += w * radiance[3 * (i64)hits[i].id + ch];
            T -= w;
        }
        if (count) after = hits[count - 1];
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
            r.hit[i] = trace_ray(*r.bvh, ray_at(r.origins + 3 * i, r.directions + 3 * i),
                                 r.has_radiance ? r.radiance : nullptr, r.transmittance + i, r.out + 3 * i);
}

INLINE bool above(const float* n, const float* d) { return n[0] * d[0] + n[1] * d[1] + n[2] * d[2] > 0; }

static void visible_share(const Rays& r, int share) {
    for (i64 p = share; p < r.n_rays; p += r.threads) {
        int* words = r.bits + p * r.words;
        clear(words, (i64)4 * r.words);
        for (int j = 0; j < r.n_directions; j++) {
            const float* d = r.directions + 3 * j;
            if (above(r.normals + 3 * p, d) && is_visible(*r.bvh, ray_at(r.origins + 3 * p, d)))
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
            *hit = blocked ? trace_ray(*r.bvh, ray_at(r.origins + 3 * p, d), nullptr, nullptr, nullptr) : -1;
        }
}
