// The plain C ABI of the CPU backend. One translation unit, no C or C++ library.
#include "bin.h"
#include "composite.h"
#include "parallel.h"
#include "project.h"

#define API extern "C" __attribute__((visibility("default")))

API int lanes() { return LANES; }

API int raster_size() { return sizeof(Raster); }

// Project, sort and count: how many pairs of a Gaussian and a tile there will be.
API int raster_prepare(Raster* r) {
    parallel(r->threads, [=](int share) { project_share(*r, share); });
    sort_by_depth(*r);
    parallel(r->threads, [=](int share) { count_share(*r, share); });
    place(*r);
    return r->n_pairs;
}

template <int C>
static void forward(Raster* r) {
    parallel(r->threads, [=](int share) { composite_share<C>(*r, share); });
}
template <int C>
static void adjoint(Raster* r) {
    parallel(r->threads, [=](int share) { adjoint_share<C>(*r, share); });
}

// The list has room for the pairs now.
API void raster_forward(Raster* r) {
    parallel(r->threads, [=](int share) { list_share(*r, share); });
    switch ((r->c + 3) / 4) {
        case 0: forward<0>(r); break;
        case 1: forward<4>(r); break;
        case 2: forward<8>(r); break;
        case 3: forward<12>(r); break;
        default: forward<16>(r);
    }
    for (int i = 0; i < r->n; i++) {
        float weight = 0;
        int touched = 0;
        for (int part = 0; part < r->threads; part++) {
            weight += r->weight_parts[(i64)part * r->n + i];
            touched += r->touched_parts[(i64)part * r->n + i];
        }
        r->weight[i] = weight, r->touched[i] = touched;
    }
}

API void raster_adjoint(Raster* r) {
    switch ((r->c + 3) / 4) {
        case 0: adjoint<0>(r); break;
        case 1: adjoint<4>(r); break;
        case 2: adjoint<8>(r); break;
        case 3: adjoint<12>(r); break;
        default: adjoint<16>(r);
    }
    parallel(r->threads, [=](int share) { project_adjoint_share(*r, share); });
    for (int j = 0; j < CAMERA; j++) {
        r->v_camera[j] = 0;
        for (int part = 0; part < r->threads; part++) r->v_camera[j] += r->camera_parts[part * CAMERA + j];
    }
}
