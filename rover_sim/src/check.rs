//! Checks of a simulation's description: field, what was found, what was expected.

use crate::{
    SimulationError,
    arm::CONTACT_FREQUENCY_HZ,
    description::{SimulationDescription, TerrainDescription},
};
use rover_robot::Robot;
use std::ops::RangeInclusive;

/// Most triangles of the ground.
const MOST_CELLS: f64 = 1e6;

type Checked = Result<(), SimulationError>;

fn within(field: &str, value: f64, range: RangeInclusive<f64>) -> Checked {
    if range.contains(&value) {
        return Ok(());
    }
    let expected = format!("{} to {}", range.start(), range.end());
    Err(SimulationError::field(field, value, expected))
}

fn all_within(checks: &[(&str, f64, RangeInclusive<f64>)]) -> Checked {
    checks
        .iter()
        .try_for_each(|(field, value, range)| within(field, *value, range.clone()))
}

/// Checks everything that a world is built from.
pub(crate) fn description(d: &SimulationDescription, robot: &Robot, start_rad: &[f64]) -> Checked {
    within("step_s", d.step_s, 1e-4..=0.005)?;
    let r = robot.description();
    let wheels_s = r.mobility.as_ref().map(|m| m.heartbeat_s);
    let mast_s = r.mast.as_ref().map(|m| m.heartbeat_s);
    for heartbeat_s in [Some(r.arm.heartbeat_s), wheels_s, mast_s]
        .into_iter()
        .flatten()
    {
        let steps = heartbeat_s / d.step_s;
        if (steps - steps.round()).abs() > 1e-6 || steps < 0.5 {
            let expected = format!("a whole fraction of the robot's heartbeat of {heartbeat_s} s");
            return Err(SimulationError::field("step_s", d.step_s, expected));
        }
    }
    truth(d)?;
    terrain(d)?;
    all_within(&[
        ("sun.azimuth_deg", d.sun.azimuth_deg, -360.0..=360.0),
        ("sun.elevation_deg", d.sun.elevation_deg, 1.0..=90.0),
        ("sun.intensity", d.sun.intensity, 0.0..=100.0),
        ("sun.ambient", d.sun.ambient, 0.0..=100.0),
        ("image.exposure_dn", d.image.exposure_dn, 1.0..=1e6),
        ("image.psf_sigma_px", d.image.psf_sigma_px, 0.0..=3.0),
        ("image.read_noise_dn", d.image.read_noise_dn, 0.0..=100.0),
        (
            "image.electrons_per_dn",
            d.image.electrons_per_dn,
            0.0..=1e6,
        ),
    ])?;
    driver_and_contact(d, robot)?;
    if let Some(o) = &d.occlusion {
        within(
            "occlusion.fiducial_hidden_within_m",
            o.fiducial_hidden_within_m,
            0.0..=10.0,
        )?;
        if d.target.is_none() {
            return Err(SimulationError::field(
                "target",
                "none",
                "a pair and a pixel: occlusion is measured from the surface seen there",
            ));
        }
    }
    if let Some(t) = &d.target {
        let pair = robot
            .pair(&t.pair)
            .map_err(|e| SimulationError::field("target.pair", &t.pair, e.to_string()))?;
        if !pair.cameras.left.contains(&t.pixel_px.into(), 0.0) {
            let found = format!("{:?}", t.pixel_px);
            return Err(SimulationError::field(
                "target.pixel_px",
                found,
                "a pixel of the image",
            ));
        }
    }
    if let Some(v) = &d.faults.rock_vanishes {
        let field = d.terrain.field.map_or(0, |f| f.count_n);
        let rocks = d.terrain.rocks.len() as u32 + d.terrain.scattered.count_n + field;
        if v.rock_n >= rocks {
            let expected = format!("below the number of rocks, {rocks}");
            return Err(SimulationError::field(
                "faults.rock_vanishes.rock_n",
                v.rock_n,
                expected,
            ));
        }
    }
    start(robot, start_rad)
}

fn truth(d: &SimulationDescription) -> Checked {
    let t = &d.truth;
    all_within(&[
        ("truth.angle_deg", t.angle_deg, 0.0..=20.0),
        ("truth.length_mm", t.length_mm, 0.0..=100.0),
        ("truth.encoder_noise_rad", t.encoder_noise_rad, 0.0..=0.1),
        ("truth.backlash_rad", t.backlash_rad, 0.0..=0.1),
        (
            "truth.intrinsics.focal_fraction",
            t.intrinsics.focal_fraction,
            0.0..=0.2,
        ),
        (
            "truth.intrinsics.principal_point_px",
            t.intrinsics.principal_point_px,
            0.0..=100.0,
        ),
        (
            "truth.mobility_scale",
            t.mobility_scale.unwrap_or(1.0),
            0.0..=20.0,
        ),
    ])
}

fn terrain(d: &SimulationDescription) -> Checked {
    let t = &d.terrain;
    all_within(&[
        ("terrain.centre_m[0]", t.centre_m[0], -100.0..=100.0),
        ("terrain.centre_m[1]", t.centre_m[1], -100.0..=100.0),
        ("terrain.size_m[0]", t.size_m[0], 0.1..=100.0),
        ("terrain.size_m[1]", t.size_m[1], 0.1..=100.0),
        ("terrain.height_m", t.height_m, -10.0..=10.0),
        ("terrain.cell_m", t.cell_m, 1e-3..=1.0),
        ("terrain.relief_m", t.relief_m, 0.0..=1.0),
        (
            "terrain.relief_wavelength_m",
            t.relief_wavelength_m,
            1e-2..=100.0,
        ),
        ("terrain.relief_gain", t.relief_gain, 0.0..=1.0),
    ])?;
    let cells = t.size_m[0] * t.size_m[1] / (t.cell_m * t.cell_m);
    if cells > MOST_CELLS {
        let expected = format!("at most {MOST_CELLS} cells on the ground, these are {cells:.0}");
        return Err(SimulationError::field("terrain.cell_m", t.cell_m, expected));
    }
    for (i, rock) in t.rocks.iter().enumerate() {
        let field = |name: &str| format!("terrain.rocks[{i}].{name}");
        for x in rock.position_m {
            within(&field("position_m"), x, -100.0..=100.0)?;
        }
        within(&field("radius_m"), rock.radius_m, 1e-3..=10.0)?;
        within(&field("roughness"), rock.roughness, 0.0..=0.5)?;
        within(
            &field("subdivisions_n"),
            f64::from(rock.subdivisions_n),
            0.0..=7.0,
        )?;
    }
    let s = &t.scattered;
    all_within(&[
        (
            "terrain.scattered.count_n",
            f64::from(s.count_n),
            0.0..=2000.0,
        ),
        ("terrain.scattered.radius_m[0]", s.radius_m[0], 1e-3..=1.0),
        (
            "terrain.scattered.radius_m[1]",
            s.radius_m[1],
            s.radius_m[0]..=1.0,
        ),
        (
            "terrain.scattered.subdivisions_n",
            f64::from(s.subdivisions_n),
            0.0..=5.0,
        ),
    ])?;
    field_and_soil(t)
}

fn field_and_soil(t: &TerrainDescription) -> Checked {
    if let Some(f) = &t.field {
        all_within(&[
            ("terrain.field.count_n", f64::from(f.count_n), 0.0..=500.0),
            ("terrain.field.radius_m[0]", f.radius_m[0], 1e-2..=3.0),
            (
                "terrain.field.radius_m[1]",
                f.radius_m[1],
                f.radius_m[0]..=3.0,
            ),
            ("terrain.field.buried", f.buried, -1.0..=0.9),
            ("terrain.field.roughness", f.roughness, 0.0..=0.5),
            (
                "terrain.field.subdivisions_n",
                f64::from(f.subdivisions_n),
                0.0..=7.0,
            ),
            ("terrain.field.clear_m", f.clear_m, 0.0..=100.0),
            ("terrain.field.gap_m", f.gap_m, 0.0..=100.0),
        ])?;
    }
    let Some(s) = &t.soil else {
        return Ok(());
    };
    all_within(&[
        (
            "terrain.soil.resistance_ratio",
            s.resistance_ratio,
            0.0..=0.5,
        ),
        ("terrain.soil.variation", s.variation, 0.0..=1.0),
        ("terrain.soil.wavelength_m", s.wavelength_m, 0.05..=100.0),
    ])?;
    for (i, patch) in s.soft.iter().enumerate() {
        let field = |name: &str| format!("terrain.soil.soft[{i}].{name}");
        within(&field("radius_m"), patch.radius_m, 0.05..=50.0)?;
        within(&field("factor"), patch.factor, 0.0..=25.0)?;
    }
    Ok(())
}

fn driver_and_contact(d: &SimulationDescription, robot: &Robot) -> Checked {
    let (v, c) = (&d.driver, &d.contact);
    all_within(&[
        (
            "driver.start_tolerance_rad",
            v.start_tolerance_rad,
            1e-9..=0.1,
        ),
        (
            "driver.max_following_error_rad",
            v.max_following_error_rad,
            1e-6..=1.0,
        ),
        ("driver.stop_ramp_s", v.stop_ramp_s, 0.0..=0.06),
        ("driver.rest_rate_rad_s", v.rest_rate_rad_s, 1e-9..=1e-2),
        ("driver.settle_limit_s", v.settle_limit_s, 0.1..=60.0),
        (
            "contact.natural_frequency_hz",
            c.natural_frequency_hz,
            CONTACT_FREQUENCY_HZ,
        ),
        ("contact.damping_ratio", c.damping_ratio, 0.1..=20.0),
        ("contact.friction", c.friction, 0.0..=5.0),
        ("contact.plunger_mass_kg", c.plunger_mass_kg, 1e-3..=0.5),
        (
            "contact.plunger_damping_ns_m",
            c.plunger_damping_ns_m,
            0.0..=1e3,
        ),
        ("contact.footprint_m", c.footprint_m, 1e-3..=0.1),
    ])?;
    let tool = &robot.description().tool.switch;
    within(
        "contact.hysteresis_m",
        c.hysteresis_m,
        0.0..=tool.closes_at_m,
    )?;
    let last = robot
        .description()
        .dynamics
        .as_ref()
        .and_then(|d| d.links.last());
    if let Some(link) = last
        && link.mass_kg < 2.0 * c.plunger_mass_kg
    {
        let expected = format!(
            "at most half of the last link's mass of {} kg",
            link.mass_kg
        );
        return Err(SimulationError::field(
            "contact.plunger_mass_kg",
            c.plunger_mass_kg,
            expected,
        ));
    }
    Ok(())
}

fn start(robot: &Robot, start_rad: &[f64]) -> Checked {
    robot.arm.check_limits(start_rad).map_err(|e| {
        SimulationError::field("start posture", format!("{start_rad:?}"), e.to_string())
    })
}
