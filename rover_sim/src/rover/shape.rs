//! What the rover looks like: body, suspension, wheels, mast.

use super::wheel_centres_m;
use crate::eyes::{capsule_mesh, encloses};
use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use rover_render::{DynamicPart, Mesh, Surface, shapes};
use rover_robot::{Capsule, MobilityDescription, Robot};

/// Segments of a wheel's rim.
const SEGMENTS: usize = 40;
const BAR_M: f64 = 0.018;

/// The parts in the order of [`crate::world`]'s poses: body, rockers, bogies, wheels, and, with a
/// mast, what pan turns and the head. Every part is given in its own frame.
pub(crate) fn vehicle_parts(robot: &Robot, mobility: &MobilityDescription) -> Vec<DynamicPart> {
    let d = robot.description();
    let centres = wheel_centres_m(mobility);
    // Wheels and head are among the shapes for collision checks, and are drawn as such.
    let head = d
        .mast
        .map(|m| m.rover_from_head(0.0, 0.0).isometry.translation.vector);
    let mut body = Mesh::default();
    for capsule in &d.body {
        let drawn_apart = centres.iter().chain(&head).any(|p| encloses(capsule, p));
        if !drawn_apart {
            body.append(&capsule_mesh(capsule));
        }
    }
    let mut parts = vec![painted(body, 0.55, 40)];
    for side in 0..2 {
        let [rocker, bogie] = pivots(mobility, side);
        let inwards = if side == 0 { -1.0 } else { 1.0 };
        let mut mesh = bar(&Vector3::zeros(), &(bogie - rocker));
        leg(&mut mesh, &(centres[side] - rocker), inwards, mobility);
        parts.push(painted(mesh, 0.5, 41 + side as u32));
    }
    for side in 0..2 {
        let [_, bogie] = pivots(mobility, side);
        let inwards = if side == 0 { -1.0 } else { 1.0 };
        let mut mesh = Mesh::default();
        for axle in [2, 4] {
            leg(
                &mut mesh,
                &(centres[axle + side] - bogie),
                inwards,
                mobility,
            );
        }
        parts.push(painted(mesh, 0.5, 43 + side as u32));
    }
    for i in 0..6 {
        parts.push(DynamicPart {
            mesh: wheel(mobility),
            surface: Surface::metal(50 + i),
        });
    }
    if d.mast.is_some() {
        let neck = bar(&Vector3::zeros(), &Vector3::new(0.0, 0.0, 0.05));
        parts.push(painted(neck, 0.5, 60));
        // Behind the cameras' centres, so that it is never before them.
        let housing = Capsule {
            from_m: [-0.03, -0.12, 0.02],
            to_m: [-0.03, 0.12, 0.02],
            radius_m: 0.03,
        };
        parts.push(painted(capsule_mesh(&housing), 0.6, 61));
    }
    parts
}

fn painted(mesh: Mesh, albedo: f64, seed: u32) -> DynamicPart {
    DynamicPart {
        mesh,
        surface: Surface::paint(albedo, seed),
    }
}

fn pivots(d: &MobilityDescription, side: usize) -> [Vector3<f64>; 2] {
    let y = if side == 0 { 0.5 } else { -0.5 } * d.track_m;
    [d.rocker_pivot_m, d.bogie_pivot_m].map(|[x, z]| Vector3::new(x, y, z))
}

fn bar(from: &Vector3<f64>, to: &Vector3<f64>) -> Mesh {
    capsule_mesh(&Capsule {
        from_m: (*from).into(),
        to_m: (*to).into(),
        radius_m: BAR_M,
    })
}

/// From the origin over a wheel to its inner side and down to the hub.
fn leg(mesh: &mut Mesh, hub: &Vector3<f64>, inwards: f64, d: &MobilityDescription) {
    let over = hub.z + d.wheel_radius_m + 0.04;
    let aside = inwards * (d.wheel_width_m / 2.0 + 0.03);
    let knee = Vector3::new(hub.x, 0.0, over);
    let shoulder = knee + Vector3::new(0.0, aside, 0.0);
    let foot = Vector3::new(hub.x, aside, hub.z);
    for (from, to) in [(Vector3::zeros(), knee), (knee, shoulder), (shoulder, foot)] {
        mesh.append(&bar(&from, &to));
    }
}

/// A wheel about y, centred on the origin.
fn wheel(d: &MobilityDescription) -> Mesh {
    let upright = UnitQuaternion::from_scaled_axis(Vector3::x() * -std::f64::consts::FRAC_PI_2);
    let place = Isometry3::from_parts(
        Vector3::new(0.0, -d.wheel_width_m / 2.0, 0.0).into(),
        upright,
    );
    shapes::cylinder(d.wheel_radius_m, d.wheel_width_m, SEGMENTS).transformed(&place)
}
