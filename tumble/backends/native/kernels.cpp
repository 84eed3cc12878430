// The plain C ABI of the CPU backend, one translation unit that needs no C or C++ library.
#include "bin.h"
#include "bundle.h"
#include "bvh.h"
#include "composite.h"
#include "gaussian_terms.h"
#include "image.h"
#include "lookup.h"
#include "maps.h"
#include "material.h"
#include "parallel.h"
#include "parameters.h"
#include "prefilter.h"
#include "project.h"
#include "relight.h"
#include "sh_shade.h"
#include "shade.h"
#include "shading_term.h"

#define API extern "C" __attribute__((visibility("default")))

API int lanes() { return LANES; }

// Sizes of the structures, which the caller compares with its own.
API int sizes(int which) {
    const int all[] = {sizeof(Raster), sizeof(Bvh), sizeof(Rays), sizeof(Shade), sizeof(ShShade), sizeof(Image),
                       sizeof(GaussianTerms), sizeof(Lookup), sizeof(Activation), sizeof(Indirect), sizeof(MaterialImage),
                       sizeof(Relight), sizeof(GaussianActivation), sizeof(AdamLeaf), sizeof(AdamStep),
                       sizeof(ShadingTerm), sizeof(Prefilter), sizeof(Fusion), sizeof(Baking), sizeof(Bundle),
                       sizeof(Leaf), sizeof(Node)};
    return all[which];
}

// Projects, sorts and counts; returns the number of pairs of a Gaussian and a tile, the required length of `list`.
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

// Must be called after raster_prepare, with `list` allocated.
API void raster_forward(Raster* r) {
    parallel(r->threads, [=](int share) { list_share(*r, share); });
    switch ((r->c + 3) / 4) {
        case 0: forward<0>(r); break;
        case 1: forward<4>(r); break;
        case 2: forward<8>(r); break;
        case 3: forward<12>(r); break;
        default: forward<16>(r);
    }
    parallel(r->threads, [=](int share) { add_share(*r, share); });
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

API void bvh_build(Bvh* t, float* fields) {
    leaf_fields(*t, fields);
    sort_by_halving(*t);
    fill_tree(*t, fields);
}

API void rays_trace(const Rays* r) {
    parallel(r->threads, [=](int share) { trace_share(*r, share); });
}
API void rays_visible(const Rays* r) {
    parallel(r->threads, [=](int share) { visible_share(*r, share); });
}
API void rays_blockers(const Rays* r) {
    parallel(r->threads, [=](int share) { blockers_share(*r, share); });
}

API void shade_forward(const Shade* s) {
    parallel(s->threads, [=](int share) { shade_share(*s, share); });
}
API void shade_adjoint(const Shade* s) {
    parallel(s->threads, [=](int share) { shade_adjoint_share(*s, share); });
    add_parts(s->v_radiance, s->radiance_parts, (i64)3 * s->stride, s->threads);
    add_parts(s->v_blocker_radiance, s->blocker_parts, (i64)3 * s->n_blockers, s->threads);
}

API void sh_shade_forward(const ShShade* s) {
    ShLight light;
    sh_light(*s, light);
    parallel(s->threads, [=, &light](int share) { sh_shade_share(*s, light, share); });
}
API void sh_shade_adjoint(const ShShade* s) {
    ShLight light;
    sh_light(*s, light);
    parallel(s->threads, [=, &light](int share) { sh_shade_adjoint_share(*s, light, share); });
}

API void activation_forward(const GaussianActivation* s) {
    parallel(s->threads, [=](int share) { gaussian_activation_share(*s, share); });
}
API void activation_adjoint(const GaussianActivation* s) {
    parallel(s->threads, [=](int share) { gaussian_activation_adjoint_share(*s, share); });
}
API int adam(const AdamStep* s) { return adam_step(*s); }

API void image_loss(const Image* m) { image_terms(*m); }
API void gaussian_loss(const GaussianTerms* s) { gaussian_terms(*s); }

API void lookup_forward(const Lookup* s) { lookup_values(*s, 0, 1); }
API void lookup_backward(const Lookup* s) { lookup_adjoint(*s); }

API void material_forward(const Activation* m) {
    parallel(m->threads, [=](int share) { activate_share(*m, share); });
}
API void material_adjoint(const Activation* m) {
    parallel(m->threads, [=](int share) { activate_adjoint_share(*m, share); });
}
API void bounce_forward(const Indirect* s) { bounce_values(*s, false); }
API void bounce_adjoint(const Indirect* s) { bounce_values(*s, true); }
API void material_loss(const MaterialImage* m) { material_terms(*m); }

API void prefilter_forward(const Prefilter* s) { prefilter_map(*s); }
API void prefilter_backward(const Prefilter* s) { prefilter_adjoint(*s); }

API void shading_loss(const ShadingTerm* s) { shading_term(*s); }

API void relight_points(const Relight* s) {
    parallel(s->threads, [=](int share) { relight_share(*s, share); });
}

API void maps_fuse(const Fusion* s) {
    parallel(s->threads, [=](int share) { fuse_share(*s, share); });
}
API void maps_blend(const Baking* s) {
    parallel(s->threads, [=](int share) { blend_share(*s, share); });
}

API void bundle_cost(const Bundle* b) {
    parallel(b->threads, [=](int share) { bundle_cost_share(*b, share); });
}
API void bundle_reduce(const Bundle* b) {
    parallel(b->threads, [=](int share) { bundle_reduce_share(*b, share); });
}
API void bundle_move(const Bundle* b) {
    parallel(b->threads, [=](int share) { bundle_move_share(*b, share); });
}
