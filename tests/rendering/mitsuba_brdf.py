"""The BRDF of the method as a Mitsuba plugin, to compare renderings with Mitsuba's path tracer."""

import math
from typing import Any

import numpy as np

from tumble.synthetic.pathtracer import Part, mitsuba


def scene(part: Part, light: Any, *, albedo: float, roughness: float, f0: float, depth: int) -> Any:
    """A mesh of one material under a light, as a scene of `pathtracer.lit_scene`."""
    from tumble.synthetic import pathtracer

    mi = mitsuba()
    _register()
    props = mi.Properties()
    props["bsdf"] = mi.load_dict({"type": "tumble_brdf", "albedo": albedo, "roughness": roughness, "f0": f0})
    mesh = mi.Mesh("part", len(part.vertices), len(part.faces), has_vertex_normals=True, props=props)
    params = mi.traverse(mesh)
    params["vertex_positions"] = part.vertices.astype(np.float32).ravel()
    params["vertex_normals"] = part.normals.astype(np.float32).ravel()
    params["faces"] = part.faces.astype(np.uint32).ravel()
    params.update()
    return pathtracer.lit_scene({"part": mesh}, light, depth)


_registered: list[str] = []


def _register() -> None:
    mi = mitsuba()
    if mi.variant() in _registered:
        return
    import drjit as dr

    class Brdf(mi.BSDF):  # type: ignore[misc, name-defined]
        """Lambert and GGX as in paper section 4.3 with Fresnel's equations for glass; half of the samples from GGX."""

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.albedo, self.roughness, self.f0 = props["albedo"], props["roughness"], props["f0"]
            flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
            self.m_components = [flags]
            self.m_flags = flags

        def _cosines(self, si: Any, wo: Any) -> tuple[Any, Any, Any, Any]:
            h = dr.normalize(si.wi + wo)
            return mi.Frame3f.cos_theta(wo), mi.Frame3f.cos_theta(si.wi), h.z, dr.dot(wo, h)

        def _ndf(self, noh: Any) -> Any:
            a2 = self.roughness**4
            return a2 / (math.pi * dr.square(dr.square(noh) * (a2 - 1) + 1))

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            nol, nov, noh, voh = self._cosines(si, wo)
            fresnel = self.f0 / 0.04 * mi.fresnel(voh, 1.5)[0]
            # Smith's G: 2 x / G1(x) for either direction.
            a2 = self.roughness**4
            geometry = (nol + dr.sqrt(a2 + (1 - a2) * nol * nol)) * (nov + dr.sqrt(a2 + (1 - a2) * nov * nov))
            value = self.albedo / math.pi + self._ndf(noh) * fresnel / geometry
            return mi.Spectrum(dr.select(active & (nol > 0) & (nov > 0), value * nol, 0))

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            nol, nov, noh, voh = self._cosines(si, wo)
            density = 0.5 * (nol / math.pi + self._ndf(noh) * noh / (4 * dr.maximum(voh, 1e-6)))
            return dr.select(active & (nol > 0) & (nov > 0), density, 0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
            sine2 = self.roughness**4 * sample2.x / (1 + (self.roughness**4 - 1) * sample2.x)
            phi = 2 * math.pi * sample2.y
            h = mi.Vector3f(dr.sqrt(sine2) * dr.cos(phi), dr.sqrt(sine2) * dr.sin(phi), dr.sqrt(1 - sine2))
            mirrored = 2 * dr.dot(si.wi, h) * h - si.wi
            wo = dr.select(sample1 < 0.5, mi.warp.square_to_cosine_hemisphere(sample2), mirrored)
            value, density = self.eval_pdf(ctx, si, wo, active)
            bs = mi.BSDFSample3f()
            bs.wo, bs.pdf, bs.eta = wo, density, 1.0
            bs.sampled_component, bs.sampled_type = 0, +mi.BSDFFlags.GlossyReflection
            return bs, dr.select(density > 0, value / density, 0)

        def traverse(self, callback: Any) -> None:
            pass

        def parameters_changed(self, keys: Any) -> None:
            pass

        def to_string(self) -> str:
            return f"Brdf[{self.albedo}, {self.roughness}, {self.f0}]"

    mi.register_bsdf("tumble_brdf", Brdf)
    _registered.append(mi.variant())
