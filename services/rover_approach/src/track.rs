//! The target, found again in each new image of the approach.
//!
//! An anchor is a template cut where the target was last anchored, with the plane that stereo saw
//! there. At each stop its warp is carried along by the odometry, searched for over the covariance
//! of the prediction, aligned to subpixel, and put onto the plane that stereo sees now. When the
//! range has shrunk enough the target is anchored anew, after the relief correction.

use crate::align::{Freedom, Template, refine, search};
use crate::anchor::{Anchor, TrackRules, anchor, reach};
use crate::error::TrackError;
use crate::fix::{Attempt, Fix, Refusal};
use crate::own_shadow::lit_alike;
use crate::relief::{AnchorGeometry, corrected_pixel};
use crate::surface::{StereoPlane, measure_plane};
use crate::view::View;
use crate::warp::PlaneWarp;
use nalgebra::{Isometry3, Matrix2, Point3, Vector2};
use std::{borrow::Cow, sync::Arc};

/// Keeps a target through the stops of an approach.
#[derive(Clone, Debug)]
pub struct Tracker {
    rules: TrackRules,
    first: Anchor,
    /// Newest last; at most two.
    anchors: Vec<Anchor>,
    /// The target as found at the last stop, where that made no anchor.
    last_stop: Option<Anchor>,
    pixel_px: Vector2<f64>,
    surface: StereoPlane,
}

/// A search that reaches no farther, template px, holds one peak, and no second one that is unlike
/// its slopes.
const UNIQUE_PX: usize = 10;

/// A fix before it is accepted.
struct Candidate {
    warp: PlaneWarp,
    pixel_px: Vector2<f64>,
    surface: StereoPlane,
    score: f64,
    second_score: f64,
    innovation_px: Vector2<f64>,
    innovation_sigma: f64,
    back_px: f64,
    sigma_px: f64,
}

/// What is looked for at a stop.
struct Sought<'a> {
    view: &'a Arc<View>,
    /// Motion as odometry and attitude sensor tell it.
    now_from_last: &'a Isometry3<f64>,
    /// Covariance of the predicted pixel.
    prediction_px2: &'a Matrix2<f64>,
    last_stop: bool,
}

impl Tracker {
    /// Takes up a target designated at `pixel_px` of a view's left image; its surface is searched
    /// between the two ranges (m).
    ///
    /// # Errors
    /// [`TrackError`] if the window leaves the image or has no plane.
    pub fn designate(
        view: Arc<View>,
        pixel_px: Vector2<f64>,
        range_m: [f64; 2],
        rules: TrackRules,
    ) -> Result<Self, TrackError> {
        let surface = measure_plane(&view, &pixel_px, range_m, None, &rules.plane)?;
        if surface.score < rules.min_plane_score {
            return Err(TrackError::NotPlanar {
                score: surface.score,
                limit: rules.min_plane_score,
            });
        }
        let first = anchor(view, pixel_px, &surface, &rules)?;
        Ok(Self {
            rules,
            anchors: vec![first.clone()],
            last_stop: None,
            first,
            pixel_px,
            surface,
        })
    }

    /// Where the target is, as of the last fix: pixel and surface, rover frame of that stop.
    #[must_use]
    pub fn target(&self) -> (&Vector2<f64>, &StereoPlane) {
        (&self.pixel_px, &self.surface)
    }

    /// The anchor of the designation, carried along.
    #[must_use]
    pub fn first(&self) -> &Anchor {
        &self.first
    }

    /// The rules.
    #[must_use]
    pub fn rules(&self) -> &TrackRules {
        &self.rules
    }

    /// The newest anchor.
    #[must_use]
    pub fn newest(&self) -> &Anchor {
        self.anchors.last().unwrap_or(&self.first)
    }

    /// Where the newest anchor's warp and `now_from_last` predict the target in a camera.
    #[must_use]
    pub fn predicted_pixel(
        &self,
        camera: &rover_cameras::Camera,
        now_from_last: &Isometry3<f64>,
    ) -> Option<Vector2<f64>> {
        self.newest()
            .warp
            .moved(now_from_last)
            .pixel(camera, &Vector2::zeros())
    }

    /// Finds the target in the view of the next stop. `now_from_last` is the rover's motion as
    /// odometry and attitude sensor tell it, `prediction_px2` the covariance of the predicted
    /// pixel. `last_stop` asks for the relief correction in any case. On a refusal nothing
    /// changes, so that another image of the same stop may be tried.
    ///
    /// # Errors
    /// [`Refusal`] with each attempt's reason.
    pub fn update(
        &mut self,
        view: &Arc<View>,
        now_from_last: &Isometry3<f64>,
        prediction_px2: &Matrix2<f64>,
        last_stop: bool,
    ) -> Result<Fix, Refusal> {
        let sought = Sought {
            view,
            now_from_last,
            prediction_px2,
            last_stop,
        };
        let mut attempts = Vec::new();
        let newest = self.anchors.len() - 1;
        let mut plan = vec![(Attempt::Affine, newest), (Attempt::Translation, newest)];
        if newest > 0 {
            plan.push((Attempt::PreviousAnchor, newest - 1));
        }
        for (attempt, index) in plan {
            match self.attempt(&sought, attempt, index) {
                Ok(found) => return Ok(self.accept(&sought, (attempt, index, found))),
                Err(error) => attempts.push((attempt, error)),
            }
        }
        if let Some(last) = self.last_stop.clone() {
            let before = self.anchors.clone();
            let index = self.push(last);
            match self.attempt(&sought, Attempt::LastStop, index) {
                Ok(found) => return Ok(self.accept(&sought, (Attempt::LastStop, index, found))),
                Err(error) => attempts.push((Attempt::LastStop, error)),
            }
            self.anchors = before;
        }
        Err(Refusal { attempts })
    }

    /// Keeps an anchor as the newest, and its index.
    fn push(&mut self, anchor: Anchor) -> usize {
        self.anchors.push(anchor);
        if self.anchors.len() > 2 {
            self.anchors.remove(0);
        }
        self.anchors.len() - 1
    }

    fn attempt(
        &self,
        sought: &Sought<'_>,
        attempt: Attempt,
        index: usize,
    ) -> Result<Candidate, TrackError> {
        let (view, now_from_last) = (&**sought.view, sought.now_from_last);
        let rules = &self.rules;
        let gate = rules.gate(attempt);
        let camera = &view.cameras.left;
        let anchor = &self.anchors[index];
        let predicted = anchor.warp.moved(now_from_last);
        let footprint = predicted.jacobian(camera).ok_or(TrackError::NotVisible)?;
        let reach = reach(&footprint, sought.prediction_px2, rules.search_sigma)?;
        let template = self.lit_alike(view, anchor, now_from_last)?;
        let (found_px, score, second_score) =
            search(&template, &view.left, camera, &predicted, reach)?;
        if !(score >= rules.min_search_score) {
            return Err(TrackError::LowScore {
                score,
                limit: rules.min_search_score,
                columns: 2 * reach.u + 1,
                rows: 2 * reach.v + 1,
            });
        }
        let is_wide = reach.u.max(reach.v) > UNIQUE_PX;
        if is_wide && !(score - second_score >= gate.min_margin) {
            return Err(TrackError::NotUnique {
                score,
                second_score,
                margin: gate.min_margin,
            });
        }
        let (warp, _) = predicted
            .turned_to(camera, &found_px)
            .ok_or(TrackError::NotVisible)?;
        let (mut warp, mut aligned) = refine(
            &template,
            &view.left,
            camera,
            &warp,
            Freedom::Translation,
            &rules.align,
        )?;
        if attempt != Attempt::Translation {
            (warp, aligned) = refine(
                &template,
                &view.left,
                camera,
                &warp,
                Freedom::Affine,
                &rules.align,
            )?;
        }
        if !(aligned.score >= gate.min_score) {
            return Err(TrackError::LowScore {
                score: aligned.score,
                limit: gate.min_score,
                columns: 2 * reach.u + 1,
                rows: 2 * reach.v + 1,
            });
        }
        let pixel_px = warp
            .pixel(camera, &Vector2::zeros())
            .ok_or(TrackError::NotVisible)?;
        let expected_px = predicted
            .pixel(camera, &Vector2::zeros())
            .ok_or(TrackError::NotVisible)?;
        let innovation_px = pixel_px - expected_px;
        let innovation_sigma = sought
            .prediction_px2
            .try_inverse()
            .map_or(0.0, |p| innovation_px.dot(&(p * innovation_px)).sqrt());
        if !(innovation_sigma <= gate.max_innovation_sigma) {
            return Err(TrackError::Unexpected {
                distance_px: innovation_px.norm(),
                sigmas: innovation_sigma,
                limit: gate.max_innovation_sigma,
            });
        }
        let plane = self.plane_at(view, &pixel_px, &predicted, now_from_last)?;
        let warp = warp
            .onto(camera, &plane.plane)
            .ok_or(TrackError::NotVisible)?;
        let back_px = self.track_back(view, anchor, now_from_last, &pixel_px, &warp)?;
        if !(back_px <= rules.max_back_px) {
            return Err(TrackError::NotMutual {
                distance_px: back_px,
                limit_px: rules.max_back_px,
            });
        }
        let spread = footprint * aligned.covariance_px2 * footprint.transpose();
        Ok(Candidate {
            warp,
            pixel_px,
            surface: plane,
            score: aligned.score,
            second_score,
            innovation_px,
            innovation_sigma,
            back_px,
            sigma_px: spread.diagonal().max().sqrt(),
        })
    }

    /// An anchor's template with the pixels that the rover's own shadow leaves.
    fn lit_alike<'t>(
        &self,
        view: &View,
        anchor: &'t Anchor,
        now_from_last: &Isometry3<f64>,
    ) -> Result<Cow<'t, Template>, TrackError> {
        let template = &anchor.template;
        let places = template.half.offsets().map(|d| {
            let last = Point3::from(anchor.warp.point(&d)?);
            let then = anchor.anchor_from_rover * last;
            Some([then.coords, (now_from_last * last).coords])
        });
        let shadows = [anchor.view.own_shadow.as_ref(), view.own_shadow.as_ref()];
        Ok(match lit_alike(shadows, places, template.weights())? {
            Some(counts) => Cow::Owned(template.masked(&counts)),
            None => Cow::Borrowed(template),
        })
    }

    /// Stereo at a pixel, with the last plane as prior of slant and range.
    fn plane_at(
        &self,
        view: &View,
        pixel_px: &Vector2<f64>,
        predicted: &PlaneWarp,
        now_from_last: &Isometry3<f64>,
    ) -> Result<StereoPlane, TrackError> {
        let centre = view.cameras.left.model.cahv()[0];
        let point = predicted
            .point(&Vector2::zeros())
            .ok_or(TrackError::NotVisible)?;
        let range = (point - centre).norm();
        let fraction = self.rules.plane.range_fraction;
        let limits = [range * (1.0 - fraction), range * (1.0 + fraction)];
        let normal = now_from_last.rotation * self.surface.plane.normal;
        measure_plane(view, pixel_px, limits, Some(&normal), &self.rules.plane)
    }

    /// Follows a template cut here back to the anchor image; returns how far from the anchor
    /// pixel it ends, px.
    fn track_back(
        &self,
        view: &View,
        anchor: &Anchor,
        now_from_last: &Isometry3<f64>,
        pixel_px: &Vector2<f64>,
        warp: &PlaneWarp,
    ) -> Result<f64, TrackError> {
        let camera = &view.cameras.left;
        let template = Template::cut(&view.left, pixel_px, anchor.template.half)?;
        let anchor_from_now = anchor.anchor_from_rover * now_from_last.inverse();
        let places = template.half.offsets().map(|d| {
            let here = warp.point(&warp.offset(camera, &(pixel_px + d))?)?;
            Some([(anchor_from_now * Point3::from(here)).coords, here])
        });
        let shadows = [anchor.view.own_shadow.as_ref(), view.own_shadow.as_ref()];
        let template = match lit_alike(shadows, places, template.weights())? {
            Some(counts) => template.masked(&counts),
            None => template,
        };
        let back = warp
            .jacobian(camera)
            .and_then(|j| j.try_inverse())
            .ok_or(TrackError::NotVisible)?;
        // pixels of this window in the anchor image, by the accepted warp
        let grown = template.half.grown(1);
        let aligned = template.align(Freedom::Translation, &self.rules.align, |shift, turn| {
            crate::patch::Patch::by_map(&anchor.view.left, grown, &back, |d| {
                let here = pixel_px + shift + turn * d;
                Some(anchor.pixel_px + warp.offset(camera, &here)?)
            })
        })?;
        Ok((back * aligned.shift).norm())
    }

    fn accept(
        &mut self,
        sought: &Sought<'_>,
        (attempt, index, found): (Attempt, usize, Candidate),
    ) -> Fix {
        let Sought {
            view,
            now_from_last,
            last_stop,
            ..
        } = *sought;
        let camera = &view.cameras.left;
        // what the match says about the motion: a turn about the camera
        let predicted = self.anchors[index].warp.moved(now_from_last);
        let turn = predicted
            .turned_to(camera, &found.pixel_px)
            .map_or_else(Isometry3::identity, |(_, turn)| turn);
        let corrected = turn * now_from_last;
        let carry = |anchor: &mut Anchor| {
            anchor.anchor_from_rover *= corrected.inverse();
            let moved = anchor.warp.moved(&corrected);
            let placed = moved
                .turned_to(camera, &found.pixel_px)
                .and_then(|(warp, _)| warp.onto(camera, &found.surface.plane));
            anchor.warp = placed.unwrap_or(moved);
        };
        carry(&mut self.first);
        self.anchors.iter_mut().for_each(carry);
        self.anchors[index].warp = found.warp;
        self.last_stop = None;
        self.pixel_px = found.pixel_px;
        self.surface = found.surface;
        let shrunk = self.anchors[index].range_m / found.surface.range_m >= self.rules.anchor_ratio;
        let turned = self.view_change_rad(view, index) >= self.rules.anchor_turn_rad;
        let mut relief_px = Vector2::zeros();
        let mut anchored = false;
        let renewed = shrunk || turned || last_stop;
        if renewed && let Some(moved) = self.relieved(view, index) {
            relief_px = moved.0 - self.pixel_px;
            (self.pixel_px, self.surface) = moved;
        }
        if let Ok(new) = anchor(Arc::clone(view), self.pixel_px, &self.surface, &self.rules) {
            if renewed {
                anchored = true;
                self.push(new);
            } else {
                self.last_stop = Some(new);
            }
        }
        Fix {
            pixel_px: self.pixel_px,
            surface: self.surface,
            score: found.score,
            second_score: found.second_score,
            back_px: found.back_px,
            innovation_px: found.innovation_px,
            innovation_sigma: found.innovation_sigma,
            sigma_px: found.sigma_px,
            attempt,
            anchored,
            relief_px,
        }
    }

    /// Angle at the target between the present view and that of an anchor, rad.
    fn view_change_rad(&self, view: &View, index: usize) -> f64 {
        let anchor = &self.anchors[index];
        let target = self.surface.plane.point;
        let here = view.cameras.left.model.cahv()[0] - target;
        let then = *anchor.view.cameras.left.model.cahv()[0];
        let then = anchor.anchor_from_rover.inverse() * nalgebra::Point3::from(then);
        here.angle(&(then.coords - target))
    }

    /// Carries the target along by odometry alone, where it could not be found.
    pub fn coast(&mut self, now_from_last: &Isometry3<f64>) {
        let carry = |anchor: &mut Anchor| {
            anchor.anchor_from_rover *= now_from_last.inverse();
            anchor.warp = anchor.warp.moved(now_from_last);
        };
        carry(&mut self.first);
        self.anchors
            .iter_mut()
            .chain(&mut self.last_stop)
            .for_each(carry);
        self.surface.plane = self.surface.plane.moved(now_from_last);
        let turn = now_from_last.rotation.to_rotation_matrix();
        self.surface.covariance_m2 = turn * self.surface.covariance_m2 * turn.transpose();
    }

    /// The hit after the relief correction against anchor `index`, with the surface there.
    fn relieved(&self, view: &View, index: usize) -> Option<(Vector2<f64>, StereoPlane)> {
        let rules = self.rules.relief.as_ref()?;
        let anchor = &self.anchors[index];
        let geometry = AnchorGeometry {
            camera: &anchor.view.cameras.left,
            anchor_from_rover: &anchor.anchor_from_rover,
            warp: &anchor.warp,
        };
        let pixel = corrected_pixel(view, &self.pixel_px, &self.surface.plane, &geometry, rules)?;
        let plane = self
            .plane_at(view, &pixel, &anchor.warp, &Isometry3::identity())
            .ok()?;
        Some((pixel, plane))
    }

    /// Moves the target to a better pixel of the last view, with the surface measured there, and
    /// anchors it anew.
    ///
    /// # Errors
    /// [`TrackError`] if there is no plane or no window at that pixel; nothing changes then.
    pub fn move_to(&mut self, view: &Arc<View>, pixel_px: Vector2<f64>) -> Result<(), TrackError> {
        let warp = self.newest().warp;
        let surface = self.plane_at(view, &pixel_px, &warp, &Isometry3::identity())?;
        let new = anchor(Arc::clone(view), pixel_px, &surface, &self.rules)?;
        self.push(new);
        (self.pixel_px, self.surface) = (pixel_px, surface);
        Ok(())
    }
}
