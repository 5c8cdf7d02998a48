//! One mark of the plate, by a least-squares fit of its blurred image model.
//!
//! Around a point the image is modelled as offset + gain * darkness(pixel - centre; blur). The
//! darkness comes from the plate's own geometry under the local perspective map, so the fitted
//! centre is the projection of the mark's centre and not the centroid of its image (the two differ
//! by up to half a pixel for an oblique disc).

use nalgebra::{SMatrix, SVector, Vector2};

use super::lanes::MarkModel;
use super::local_map::LocalMap;
use super::window::{EdgeDistance, GREY, MIDDLE_DN, Window};
use super::{DetectionRules, PointKind};
use crate::image::Image8;
use crate::plate::PlateLayout;

/// Why a single point was refused.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum PointFault {
    /// Its window leaves the image.
    #[error("its window around ({u_px:.1}, {v_px:.1}) leaves the image")]
    OutsideImage {
        /// Predicted pixel.
        u_px: f64,
        /// Predicted pixel.
        v_px: f64,
    },
    /// Its image is too small to be measured.
    #[error("its image has a radius of {found_px:.2} px, {needed_px} px are needed")]
    TooSmall {
        /// Radius along the shortest direction, px.
        found_px: f64,
        /// Least radius, px.
        needed_px: f64,
    },
    /// White and black differ too little, or the wrong way round.
    #[error("its contrast is {found_dn:.1} DN, {needed_dn} DN are needed")]
    LowContrast {
        /// White minus black, DN.
        found_dn: f64,
        /// Least contrast, DN.
        needed_dn: f64,
    },
    /// Its contrast is another part of its white than at the other points, whatever the light: a
    /// reflection covers it, or it is no mark.
    #[error("its contrast is {found:.2} of its white where the plate's is {plate:.2}")]
    OtherContrast {
        /// White minus black over white at this point.
        found: f64,
        /// Median over the plate.
        plate: f64,
    },
    /// The image does not look like the point: shadow edge, reflection, occlusion.
    #[error("its image differs from the model by {rms_dn:.1} DN rms, limit {limit_dn:.1} DN")]
    Misfit {
        /// Root mean square difference, DN.
        rms_dn: f64,
        /// Largest accepted difference, DN.
        limit_dn: f64,
    },
    /// White is clipped.
    #[error("{fraction:.3} of its pixels are saturated, limit {limit}")]
    Saturated {
        /// Fraction of saturated pixels.
        fraction: f64,
        /// Largest accepted fraction.
        limit: f64,
    },
    /// The fit ran away from the prediction, or did not settle.
    #[error("its fit moved {moved_px:.2} px from the prediction, limit {limit_px} px")]
    Diverged {
        /// Distance from the prediction, px.
        moved_px: f64,
        /// Largest accepted distance, px.
        limit_px: f64,
    },
    /// It does not fit the rigid plate that the other points form.
    #[error("it lies {residual_px:.2} px from its place in the plate's pose, limit {limit_px} px")]
    OffPose {
        /// Reprojection error, px.
        residual_px: f64,
        /// Largest accepted error, px.
        limit_px: f64,
    },
}

/// A fitted mark.
#[derive(Clone, Copy, Debug)]
pub(super) struct MarkFit {
    pub pixel_px: Vector2<f64>,
    pub sigma_px: f64,
    /// White minus black over white: what light and shade leave as it is.
    pub contrast: f64,
    pub blur_px: f64,
}

const MAX_STEPS: usize = 10;
/// A fit has settled when its last step was shorter than this, px; what remains is far smaller.
const SETTLED_PX: f64 = 0.005;
/// The same with a known blur and the place from the pose of all marks: what remains is a thirtieth.
const SETTLED_FROM_POSE_PX: f64 = 0.02;
/// The same for a first fit that only serves to find the pose.
const ROUGHLY_SETTLED_PX: f64 = 0.05;
/// Bounds of the fitted blur, px.
const BLUR_RANGE_PX: (f64, f64) = (0.4, 3.0);
/// Strip along the checker's border that is left out, in units of the blur.
const CHECKER_RIM: f64 = 1.5;
/// Least weight (px of window) for a fit.
const MIN_WEIGHT_PX: f64 = 16.0;

/// What is fitted around a point, apart from its position.
pub(super) struct Mark<'a> {
    pub layout: &'a PlateLayout,
    index: usize,
    kind: PointKind,
    pub at_m: Vector2<f64>,
    radius_m: f64,
    /// Half the gap to the nearest other mark, m.
    half_gap_m: f64,
}

impl<'a> Mark<'a> {
    pub fn new(layout: &'a PlateLayout, index: usize) -> Option<Self> {
        let at = layout.point(index)?;
        let at_m = Vector2::new(at.x, at.y);
        let (kind, radius_m) = match layout.discs.get(index) {
            Some(d) => (PointKind::Disc, d.radius_m),
            None => (PointKind::Saddle, layout.saddle.as_ref()?.half_size_m),
        };
        let mut gap = f64::INFINITY;
        for (_, d) in layout.discs.iter().enumerate().filter(|(i, _)| *i != index) {
            gap = gap.min((Vector2::new(d.x_m, d.y_m) - at_m).norm() - d.radius_m - radius_m);
        }
        if let (PointKind::Disc, Some(s)) = (kind, &layout.saddle) {
            let dx = ((at_m.x - s.x_m).abs() - s.half_size_m).max(0.0);
            let dy = ((at_m.y - s.y_m).abs() - s.half_size_m).max(0.0);
            gap = gap.min(dx.hypot(dy) - radius_m);
        }
        Some(Self {
            layout,
            index,
            kind,
            at_m,
            radius_m,
            half_gap_m: 0.5 * gap,
        })
    }

    fn model(&self, map: &LocalMap, blur_px: f64) -> Option<MarkModel> {
        match self.kind {
            PointKind::Disc => self
                .layout
                .discs
                .get(self.index)
                .map(|d| MarkModel::disc(map, d, blur_px)),
            PointKind::Saddle => self
                .layout
                .saddle
                .as_ref()
                .map(|s| MarkModel::saddle(map, s, blur_px)),
        }
    }
}

/// Fits position, gain, offset and, if `free_blur`, the blur; `rough` stops early.
pub(super) fn fit(
    image: &Image8,
    mark: &Mark,
    start: &LocalMap,
    blur_px: f64,
    free_blur: bool,
    rough: bool,
    rules: &DetectionRules,
) -> Result<MarkFit, PointFault> {
    let (shortest, longest) = start.scales();
    let radius_px = mark.radius_m * shortest;
    if !(radius_px >= rules.min_mark_radius_px) {
        return Err(PointFault::TooSmall {
            found_px: radius_px,
            needed_px: rules.min_mark_radius_px,
        });
    }
    let margin = rules
        .window_margin_px
        .min((mark.half_gap_m * shortest).max(1.0));
    let reach = match mark.kind {
        PointKind::Disc => mark.radius_m * longest + margin + 1.0,
        PointKind::Saddle => rules.saddle_window_px + 1.0,
    };
    let border = rules.image_border_px;
    let settled_px = match (rough, free_blur) {
        (true, _) => ROUGHLY_SETTLED_PX,
        (false, true) => SETTLED_PX,
        (false, false) => SETTLED_FROM_POSE_PX,
    };
    let (mut centre, mut blur) = (start.pixel_px, blur_px);
    let mut last = None;
    for _ in 0..MAX_STEPS {
        let inside =
            |x: f64, size: u32| x - reach >= border && x + reach <= f64::from(size) - 1.0 - border;
        if !(inside(centre.x, image.width_px) && inside(centre.y, image.height_px)) {
            return Err(PointFault::OutsideImage {
                u_px: centre.x,
                v_px: centre.y,
            });
        }
        let diverged = |moved_px: f64| PointFault::Diverged {
            moved_px,
            limit_px: rules.max_correction_px,
        };
        let step = gauss_newton_step(
            image, mark, start, centre, blur, free_blur, margin, reach, rules,
        )
        .ok_or_else(|| diverged((centre - start.pixel_px).norm()))?;
        if step.weight < MIN_WEIGHT_PX {
            return Err(PointFault::TooSmall {
                found_px: (step.weight / std::f64::consts::PI).sqrt(),
                needed_px: (MIN_WEIGHT_PX / std::f64::consts::PI).sqrt(),
            });
        }
        if step.contrast_dn < rules.min_contrast_dn {
            return Err(PointFault::LowContrast {
                found_dn: step.contrast_dn,
                needed_dn: rules.min_contrast_dn,
            });
        }
        let length = step.shift.norm();
        centre += step.shift * (1.0f64).min(1.0 / length.max(1e-9));
        blur = (blur + step.blur_shift.clamp(-0.3, 0.3)).clamp(BLUR_RANGE_PX.0, BLUR_RANGE_PX.1);
        let moved = (centre - start.pixel_px).norm();
        if !(moved <= rules.max_correction_px) {
            return Err(diverged(moved));
        }
        let settled = length < settled_px;
        last = Some((step, settled));
        if settled {
            break;
        }
    }
    let Some((step, true)) = last else {
        return Err(PointFault::Diverged {
            moved_px: (centre - start.pixel_px).norm(),
            limit_px: rules.max_correction_px,
        });
    };
    if step.saturated > rules.max_saturated_fraction {
        return Err(PointFault::Saturated {
            fraction: step.saturated,
            limit: rules.max_saturated_fraction,
        });
    }
    let limit_dn = rules.max_residual_fraction * step.contrast_dn + rules.noise_dn;
    if step.rms_dn > limit_dn {
        return Err(PointFault::Misfit {
            rms_dn: step.rms_dn,
            limit_dn,
        });
    }
    Ok(MarkFit {
        pixel_px: centre,
        sigma_px: step.sigma_px.hypot(rules.sigma_floor_px),
        contrast: step.contrast_dn / step.white_dn.max(1.0),
        blur_px: blur,
    })
}

struct Step {
    shift: Vector2<f64>,
    blur_shift: f64,
    contrast_dn: f64,
    white_dn: f64,
    rms_dn: f64,
    sigma_px: f64,
    saturated: f64,
    weight: f64,
}

/// One linearised solution around `centre`; `None` if it is singular.
#[allow(clippy::too_many_arguments)] // one inner step, called from one place
fn gauss_newton_step(
    image: &Image8,
    mark: &Mark,
    map: &LocalMap,
    centre: Vector2<f64>,
    blur_px: f64,
    free_blur: bool,
    margin_px: f64,
    reach_px: f64,
    rules: &DetectionRules,
) -> Option<Step> {
    let window = Window {
        model: mark.model(map, blur_px)?,
        edge: EdgeDistance::new(mark.layout, map),
        kind: mark.kind,
        centre,
        reach_px,
        margin_px: margin_px as f32 + 0.5,
        rim_px: (CHECKER_RIM * blur_px) as f32,
        radius_px: rules.saddle_window_px as f32 + 0.5,
        saturation_dn: f32::from(rules.saturation_dn) - MIDDLE_DN,
    };
    let (sums, saturated) = window.accumulate(image, free_blur);
    let mut normal = SMatrix::<f64, 5, 5>::zeros();
    let mut right = SVector::<f64, 5>::zeros();
    let mut square = 0.0;
    let mut at = 0;
    for p in 0..6 {
        for q in 0..=p {
            // the blur is the last of the unknowns
            let unknown = |k: usize| if k == 5 { 4 } else { k };
            match (p == GREY, q == GREY) {
                (false, false) => {
                    normal[(unknown(p), unknown(q))] = sums[at];
                    normal[(unknown(q), unknown(p))] = sums[at];
                }
                (true, true) => square = sums[at],
                (true, false) => right[unknown(q)] = sums[at],
                (false, true) => right[unknown(p)] = sums[at],
            }
            at += 1;
        }
    }
    let weight = normal[(3, 3)];
    if weight < MIN_WEIGHT_PX {
        return Some(Step {
            shift: Vector2::zeros(),
            blur_shift: 0.0,
            contrast_dn: 0.0,
            white_dn: 0.0,
            rms_dn: 0.0,
            sigma_px: 0.0,
            saturated: 0.0,
            weight,
        });
    }
    if !free_blur {
        for p in 0..4 {
            normal[(p, 4)] = 0.0;
            normal[(4, p)] = 0.0;
        }
        normal[(4, 4)] = 1.0;
        right[4] = 0.0;
    }
    let factor = normal.cholesky()?;
    let x = factor.solve(&right);
    let gain = x[2];
    if gain == 0.0 || !x.iter().all(|x| x.is_finite()) {
        return None;
    }
    let freedom = (weight - 5.0).max(1.0);
    let rms_dn = ((square - x.dot(&right)).max(0.0) / freedom).sqrt();
    // quantisation alone is 0.29 DN
    let sigma_px = rms_dn.max(0.29) * mean_variance(&factor.l()).sqrt() / gain.abs();
    Some(Step {
        shift: Vector2::new(x[0], x[1]) / gain,
        blur_shift: if free_blur { x[4] / gain } else { 0.0 },
        contrast_dn: -gain,
        white_dn: x[3] + f64::from(MIDDLE_DN),
        rms_dn,
        sigma_px,
        saturated,
        weight,
    })
}

/// Mean of the first two diagonal elements of (L L^T)^-1.
fn mean_variance(l: &SMatrix<f64, 5, 5>) -> f64 {
    let variance = |first: usize| {
        // the column of L^-1, whose square is the element
        let mut column = [0.0; 5];
        let mut sum = 0.0;
        for i in first..5 {
            let mut x = f64::from(u8::from(i == first));
            for j in first..i {
                x -= l[(i, j)] * column[j];
            }
            column[i] = x / l[(i, i)];
            sum += column[i] * column[i];
        }
        sum
    };
    0.5 * (variance(0) + variance(1))
}
