// Static shares: share i of n of a phase is the same work whoever runs it, so results repeat bit for bit for a fixed
// number of shares.
#pragma once
#include "simd.h"

template <class F>
INLINE void parallel(int shares, F phase) {
#if defined(_OPENMP)
#pragma omp parallel for schedule(static, 1) num_threads(shares) if (shares > 1)
#endif
    for (int share = 0; share < shares; share++) phase(share);
}
