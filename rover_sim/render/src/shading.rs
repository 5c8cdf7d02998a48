//! Light on a fragment: how bright it is in shadow, what the sun adds, and where it stands in the
//! sun frame.

use crate::geometry::Geometry;
use crate::optics::TileRays;
use crate::resolve::{Fragment, centroid};
use crate::scene::{Sun, Surface};
use crate::simd::{Lanes, Simd, V3, add3, dispatched, dot, load3, scale3, splat3, sub3};
use crate::texture::{self, Octave};
use crate::view::{Facet, View};
use nalgebra::{Isometry3, Vector3};

/// The bit that marks a facet of a moving body.
pub(crate) const MOVING: u32 = 1 << 31;

/// How a body reflects, ready for the kernels.
#[derive(Clone, Debug)]
pub(crate) struct Material {
    pub albedo: f32,
    specular: f32,
    shininess: u32,
    octaves: Vec<Octave>,
}

impl Material {
    pub(crate) fn new(surface: &Surface) -> Self {
        let (albedo, pattern) = surface.diffuse();
        let (specular, shininess) = surface.highlight();
        Self {
            albedo: albedo as f32,
            specular: specular as f32,
            shininess,
            octaves: texture::octaves(pattern),
        }
    }
}

/// A rigid motion: three rows of a rotation and a shift.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Motion {
    pub rows: [[f32; 3]; 3],
    pub shift: [f32; 3],
}

impl From<Isometry3<f64>> for Motion {
    fn from(pose: Isometry3<f64>) -> Self {
        let r = pose.rotation.to_rotation_matrix();
        let t = pose.translation.vector;
        Self {
            rows: [0, 1, 2].map(|i| [0, 1, 2].map(|k| r[(i, k)] as f32)),
            shift: [t.x as f32, t.y as f32, t.z as f32],
        }
    }
}

impl Motion {
    #[inline(always)]
    pub(crate) fn apply<S: Simd>(&self, p: V3<S>) -> V3<S> {
        add3::<S>(
            [
                dot::<S>(splat3::<S>(self.rows[0]), p),
                dot::<S>(splat3::<S>(self.rows[1]), p),
                dot::<S>(splat3::<S>(self.rows[2]), p),
            ],
            splat3::<S>(self.shift),
        )
    }
}

/// Where a body is, as one camera and the sun see it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BodyFrame {
    pub body_from_axis: Motion,
    pub sun_from_body: Motion,
    /// Towards the sun, body frame.
    pub to_sun: [f32; 3],
    /// Up, body frame.
    pub up: [f32; 3],
}

impl BodyFrame {
    pub(crate) fn new(
        world_from_body: &Isometry3<f64>,
        world_from_axis: &Isometry3<f64>,
        sun_from_world: &Isometry3<f64>,
        to_sun: &Vector3<f64>,
    ) -> Self {
        let body_from_world = world_from_body.inverse();
        let turned = |v: &Vector3<f64>| {
            let v = body_from_world.rotation * v;
            [v.x as f32, v.y as f32, v.z as f32]
        };
        Self {
            body_from_axis: (body_from_world * world_from_axis).into(),
            sun_from_body: (sun_from_world * world_from_body).into(),
            to_sun: turned(to_sun),
            up: turned(&Vector3::z()),
        }
    }
}

/// Strengths of the light.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Light {
    pub sun: f32,
    /// From the sky.
    pub sky: f32,
    /// From the sunlit ground, on what faces down.
    pub ground: f32,
}

impl From<&Sun> for Light {
    fn from(sun: &Sun) -> Self {
        let on_ground = sun.intensity * sun.direction_to_sun.z.max(0.0) + sun.ambient;
        Self {
            sun: sun.intensity as f32,
            sky: sun.ambient as f32,
            ground: (0.25 * on_ground) as f32,
        }
    }
}

impl Light {
    /// Diffuse light on a white surface from everywhere but the sun; `rise`: normal times up.
    #[inline(always)]
    pub(crate) fn around<S: Simd>(&self, rise: S::F) -> S::F {
        let (half, up) = (S::splat(0.5), S::splat(0.5) * rise);
        (half + up) * S::splat(self.sky) + (half - up) * S::splat(self.ground)
    }
}

/// A shaded fragment.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Point {
    /// Facet, with [`MOVING`].
    pub facet: u32,
    pub pixel: u16,
    pub mask: u16,
    /// Radiance without the sun.
    pub shade: f32,
    /// What the sun adds; zero where the surface is turned away from it.
    pub sunlight: f32,
    /// Whether a shadow edge on it matters (the sun is well above the surface).
    pub edges: bool,
    /// Position in the sun frame, lifted off the facet to the smooth surface.
    pub sun: [f32; 3],
    /// How far sub-pixel positions may lie from it, metres.
    pub reach: f32,
}

/// All that a group of fragments of one body has in common.
pub(crate) struct Group<'a> {
    pub tile: &'a TileRays,
    pub view: &'a View,
    pub geometry: &'a Geometry,
    pub frame: &'a BodyFrame,
    pub material: &'a Material,
    pub light: &'a Light,
}

dispatched! {
    /// Shades fragments of one body.
    pub(crate) fn shade = shade_kernel(
        group: &Group<'_>,
        fragments: &[Fragment],
        out: &mut Vec<Point>,
    )
}

#[inline(always)]
fn shade_kernel<S: Simd>(group: &Group<'_>, fragments: &[Fragment], out: &mut Vec<Point>) {
    for eight in fragments.chunks(8) {
        shade_eight::<S>(group, eight, out);
    }
}

/// The corners of eight triangles and the rays that meet them.
#[derive(Default)]
struct Gathered {
    ray: [Lanes; 2],
    edge: [[Lanes; 3]; 3],
    inverse_depth: [Lanes; 3],
    corner: [[Lanes; 3]; 3],
    normal: [[Lanes; 3]; 3],
}

#[inline(always)]
fn gather(group: &Group<'_>, eight: &[Fragment]) -> Gathered {
    let mut g = Gathered::default();
    for lane in 0..8 {
        let fragment = &eight[lane.min(eight.len() - 1)];
        let index = (fragment.facet & !MOVING) as usize;
        let facet: &Facet = &group.view.facets[index];
        let triangle = group.geometry.triangles[group.view.triangle[index] as usize];
        let [u, v] = centroid(fragment.mask);
        let [x, y] = group.tile.ray(usize::from(fragment.pixel));
        g.ray[0][lane] = x + u * group.tile.du[0] + v * group.tile.dv[0];
        g.ray[1][lane] = y + u * group.tile.du[1] + v * group.tile.dv[1];
        for k in 0..3 {
            g.inverse_depth[k][lane] = facet.inverse_depth[k];
            let vertex = triangle[k] as usize;
            for c in 0..3 {
                g.edge[k][c][lane] = facet.edge[k][c];
                g.corner[k][c][lane] = group.geometry.corners[vertex][c];
                g.normal[k][c][lane] = group.geometry.normals[vertex][c];
            }
        }
    }
    g
}

#[inline(always)]
fn unit<S: Simd>(v: V3<S>) -> V3<S> {
    let length = S::sqrt(S::max(dot::<S>(v, v), S::splat(1e-30)));
    scale3::<S>(v, S::splat(1.0) / length)
}

#[inline(always)]
fn clamp01<S: Simd>(x: S::F) -> S::F {
    S::max(S::min(x, S::splat(1.0)), S::splat(0.0))
}

#[inline(always)]
fn shade_eight<S: Simd>(group: &Group<'_>, eight: &[Fragment], out: &mut Vec<Point>) {
    let g = gather(group, eight);
    let (zero, one) = (S::splat(0.0), S::splat(1.0));
    let ray = [S::load(&g.ray[0]), S::load(&g.ray[1]), one];
    let mut weights = [zero; 3];
    let mut corner_normals = [[zero; 3]; 3];
    for k in 0..3 {
        weights[k] = S::max(dot::<S>(load3::<S>(&g.edge[k]), ray), zero);
        corner_normals[k] = load3::<S>(&g.normal[k]);
    }
    let total = S::max(weights[0] + weights[1] + weights[2], S::splat(1e-30));
    for w in &mut weights {
        *w = *w / total;
    }
    let plane = load3::<S>(&g.inverse_depth);
    let inverse_depth = dot::<S>(plane, ray);
    let depth = one / S::max(inverse_depth, S::splat(1e-6));
    let p = group
        .frame
        .body_from_axis
        .apply::<S>(scale3::<S>(ray, depth));

    let mut normal = [zero; 3];
    for k in 0..3 {
        normal = add3::<S>(normal, scale3::<S>(corner_normals[k], weights[k]));
    }
    let normal = unit::<S>(normal);

    // the footprint of the pixel: its size across the ray, stretched by the slant of the facet
    let slant = S::max(
        inverse_depth
            / S::sqrt(S::max(
                dot::<S>(plane, plane) * dot::<S>(ray, ray),
                S::splat(1e-30),
            )),
        S::splat(0.02),
    );
    let across = S::splat(group.tile.pixel) * depth;
    let (pattern, slope) =
        texture::sample::<S>(&group.material.octaves, p, S::sqrt(slant) / across);
    let bright = S::max(one + S::splat(0.5) * pattern, zero);
    let albedo = S::splat(group.material.albedo) * bright * bright;
    let along = dot::<S>(slope, normal);
    let rough = unit::<S>(sub3::<S>(
        normal,
        sub3::<S>(slope, scale3::<S>(normal, along)),
    ));

    let to_sun = splat3::<S>(group.frame.to_sun);
    let height = dot::<S>(normal, to_sun);
    // the relief must not light what the shape turns away from the sun
    let facing = clamp01::<S>(height * S::splat(12.0));
    let diffuse = S::max(dot::<S>(rough, to_sun), zero) * facing;
    let rise = dot::<S>(rough, splat3::<S>(group.frame.up));
    let mut sunlight = albedo * diffuse * S::splat(group.light.sun);
    if group.material.specular > 0.0 {
        let camera = splat3::<S>(group.frame.body_from_axis.shift);
        let half = unit::<S>(add3::<S>(unit::<S>(sub3::<S>(camera, p)), to_sun));
        let peak = power::<S>(
            S::max(dot::<S>(rough, half), zero),
            group.material.shininess,
        );
        let strength = S::splat(group.material.specular * group.light.sun);
        sunlight = sunlight + peak * facing * strength;
    }

    // lifted to the tangent planes of the corners (Hanika, Ray Tracing Gems II, ch. 4), so that
    // facets do not shade the smooth surface they stand for
    let mut lifted = p;
    for k in 0..3 {
        let below = dot::<S>(sub3::<S>(p, load3::<S>(&g.corner[k])), corner_normals[k]);
        let lift = (zero - S::min(below, zero)) * weights[k];
        lifted = add3::<S>(lifted, scale3::<S>(corner_normals[k], lift));
    }
    let sun = group.frame.sun_from_body.apply::<S>(lifted);
    let mut lanes = [[0.0_f32; 8]; 7];
    S::store(albedo * group.light.around::<S>(rise), &mut lanes[0]);
    S::store(sunlight, &mut lanes[1]);
    S::store(height, &mut lanes[2]);
    S::store(across, &mut lanes[3]);
    for k in 0..3 {
        S::store(sun[k], &mut lanes[4 + k]);
    }
    for (lane, fragment) in eight.iter().enumerate() {
        out.push(Point {
            facet: fragment.facet,
            pixel: fragment.pixel,
            mask: fragment.mask,
            shade: lanes[0][lane],
            sunlight: lanes[1][lane],
            edges: lanes[2][lane] > 0.02,
            sun: [lanes[4][lane], lanes[5][lane], lanes[6][lane]],
            reach: lanes[3][lane] * REACH_PX,
        });
    }
}

/// Sub-pixel positions further than this (pixels) from a fragment's own are moved to its depth.
pub(crate) const REACH_PX: f32 = 6.0;

/// `x` to an integer power, by squaring.
#[inline(always)]
fn power<S: Simd>(x: S::F, exponent: u32) -> S::F {
    let (mut result, mut base, mut left) = (S::splat(1.0), x, exponent);
    while left != 0 {
        if left & 1 == 1 {
            result = result * base;
        }
        base = base * base;
        left >>= 1;
    }
    result
}
