//! The ground under the wheels: what of a wheel's turning becomes way.
//!
//! A wheel that pulls slips, and one that sinks in has to pull to move at all. With x the ratio of
//! everything that a wheel's drive works against (slope, obstacles, and the resistance of its own
//! track) to its load, the slip is `0.4 x + 1.5 x^3`: 2 % on level firm ground, 17 % on 15 deg,
//! 40 % on 25 deg, as rovers report it. The soil varies from place to place; the rover knows its
//! mean.

use crate::description::SoilDescription;
use nalgebra::Vector3;
use rover_render::shapes;

/// Slip never exceeds this.
const MOST_SLIP: f64 = 0.95;

/// Slip of a wheel for the ratio of its pull to its load.
pub(crate) fn slip(ratio: f64) -> f64 {
    let x = ratio.clamp(-0.3, 1.0);
    (0.4 * x + 1.5 * x.powi(3)).min(MOST_SLIP)
}

/// The soil of a terrain.
#[derive(Clone, Debug)]
pub(crate) struct Soil {
    description: SoilDescription,
    seed: u64,
}

impl Soil {
    pub fn new(description: SoilDescription, seed: u64) -> Self {
        Self { description, seed }
    }

    /// Resistance of a wheel's own track over its load at a place, m.
    pub fn resistance(&self, at: &Vector3<f64>) -> f64 {
        let d = &self.description;
        let soft = d.soft.iter().fold(1.0, |factor: f64, patch| {
            let apart = (at.x - patch.centre_m[0]).hypot(at.y - patch.centre_m[1]);
            let inside = (1.0 - (apart / patch.radius_m).powi(2)).max(0.0);
            factor + (patch.factor - 1.0) * inside.min(0.5) * 2.0
        });
        d.resistance_ratio * soft
    }

    /// The mean resistance, as the rover knows it.
    pub fn mean_resistance(&self) -> f64 {
        self.description.resistance_ratio
    }

    /// Slip at a place of a wheel that pulls with `ratio` of its load, its track's resistance not
    /// included.
    pub fn slip(&self, at: &Vector3<f64>, ratio: f64) -> f64 {
        let d = &self.description;
        let p = Vector3::new(at.x, at.y, 0.0) / d.wavelength_m;
        let local = shapes::fractal_noise(&p, self.seed ^ 0x5011, 2, 0.5);
        let varied = slip(ratio + self.resistance(at)) * (1.0 + 2.0 * d.variation * local).max(0.2);
        varied.min(MOST_SLIP)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::SoftPatch;

    #[test]
    fn slip_grows_with_slope_and_in_soft_patches() {
        assert!((slip(0.04) - 0.016).abs() < 1e-3);
        let of_slope = |deg: f64| slip(deg.to_radians().tan() + 0.04);
        assert!((0.12..0.22).contains(&of_slope(15.0)));
        assert!((0.30..0.50).contains(&of_slope(25.0)));
        let soil = Soil::new(
            SoilDescription {
                soft: vec![SoftPatch {
                    centre_m: [3.0, 0.0],
                    radius_m: 1.0,
                    factor: 14.0,
                }],
                ..SoilDescription::default()
            },
            3,
        );
        assert!(soil.slip(&Vector3::new(3.0, 0.0, 0.0), 0.0) > 0.3);
        assert!(soil.slip(&Vector3::new(5.0, 0.0, 0.0), 0.0) < 0.05);
    }
}
