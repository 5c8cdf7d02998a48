//! The multibody arm against its kinematics, its statics and the theory of its switch.

use super::support::{READY, arm_model, floor};
use crate::{
    arm::{ArmModel, ArmPhysics, StaticSurface},
    contact_switch::Switch,
    statics::{drooped_angles_rad, gravity_torques_nm},
};
use nalgebra::{Isometry3, Point3, Vector3};

fn angles(arm: &ArmPhysics) -> ([f64; 5], [f64; 5]) {
    let (mut q, mut qd) = ([0.0; 5], [0.0; 5]);
    arm.read(&mut q, &mut qd);
    (q, qd)
}

/// The arm at rest with its drives' springs at `rest`.
fn at_rest(model: &ArmModel, surfaces: &[StaticSurface<'_>], rest: &[f64; 5]) -> ArmPhysics {
    let q = drooped_angles_rad(model, rest).unwrap();
    let mut arm = ArmPhysics::new(model, surfaces, &q).unwrap();
    arm.set_rest(rest);
    arm
}

fn settled(model: &ArmModel, rest: &[f64; 5]) -> ArmPhysics {
    let mut arm = ArmPhysics::new(model, &[], rest).unwrap();
    for _ in 0..2000 {
        arm.step();
    }
    arm
}

fn perturbed() -> ArmModel {
    let mut model = arm_model();
    let errors: Vec<f64> = (0..20)
        .map(|i| [0.02, 0.003, -0.002, -0.015][i % 4])
        .collect();
    model.arm = model.arm.perturbed(&errors).unwrap();
    model
}

#[test]
fn bodies_stand_where_the_true_kinematics_says() {
    for model in [arm_model(), perturbed()] {
        let mut arm = ArmPhysics::new(&model, &[], &READY).unwrap();
        for step in 0..200 {
            let rest = READY.map(|q| q + 1e-3 * f64::from(step));
            arm.set_rest(&rest);
            arm.step();
            let (q, _) = angles(&arm);
            let poses = model.arm.link_poses(&q).unwrap();
            for link in 0..5 {
                let expected = model.world_from_base * poses[link + 1];
                let found = arm.world_from_link(link);
                let apart = (found.translation.vector - expected.translation.vector).norm();
                assert!(apart < 1e-12, "link {link}: {apart} m");
                assert!(found.rotation.angle_to(&expected.rotation) < 1e-7);
            }
        }
    }
}

#[test]
fn droop_is_gravity_torque_over_stiffness() {
    for model in [arm_model(), perturbed()] {
        let arm = settled(&model, &READY);
        let (q, rates) = angles(&arm);
        let torques = gravity_torques_nm(&model, &q).unwrap();
        let expected = drooped_angles_rad(&model, &READY).unwrap();
        for i in 0..5 {
            let droop = q[i] - READY[i];
            let k = model.links[i].stiffness_nm_rad;
            assert!(
                (droop - torques[i] / k).abs() < 1e-8,
                "joint {i}: {droop} rad"
            );
            assert!((q[i] - expected[i]).abs() < 1e-8, "joint {i}");
            assert!(rates[i].abs() < 1e-9, "joint {i}: {} rad/s", rates[i]);
        }
        // A shoulder that holds four kilogrammes on an arm of 0.7 m gives way visibly.
        assert!((q[1] - READY[1]).abs() > 5e-4);
    }
}

#[test]
fn a_force_on_the_tip_bends_the_arm_by_the_transposed_jacobian_over_stiffness() {
    // Without friction the force at the tip is what the switch reports.
    let mut model = arm_model();
    model.contact.friction = 0.0;
    let free = settled(&model, &READY);
    let height = free.tip_in_world().z + 0.003;
    let (positions, triangles) = floor(height, 40);
    let surface = StaticSurface {
        name: "floor".into(),
        positions: &positions,
        triangles: &triangles,
    };
    let lift = 0.03;
    let mut arm = at_rest(&model, &[surface], &rest_of(&model, lift));
    lower(&mut arm, &model, lift, 0.0, |_, _| true);
    for _ in 0..3000 {
        arm.step();
    }
    let tip = arm.contacts().tip.expect("contact");
    let (q, _) = angles(&arm);
    let base_from_world = model.world_from_base.inverse();
    let jacobian = model.arm.jacobian(&q, &model.tip_in_link).unwrap();
    let axis = arm.world_from_plunger().rotation * Vector3::z();
    let force = base_from_world.rotation * (axis * -tip.axial_force_n);
    let gravity = gravity_torques_nm(&model, &q).unwrap();
    for i in 0..5 {
        let torque = jacobian.fixed_view::<3, 1>(0, i).dot(&force) + gravity[i];
        let bend = q[i] - rest_of(&model, 0.0)[i];
        let expected = torque / model.links[i].stiffness_nm_rad;
        assert!(
            (bend - expected).abs() < 3e-6,
            "joint {i}: {bend} rad, expected {expected}"
        );
    }
}

/// Joint angles that put the tip `lift` metres above where `READY` has it, instrument down.
fn rest_of(model: &ArmModel, lift: f64) -> [f64; 5] {
    // The instrument's direction is kept by q2 + q3 + q4, so a damped Newton in the plane does.
    let mut q = READY;
    let (p0, _) = tip(model, &READY);
    for _ in 0..50 {
        let (p, _) = tip(model, &q);
        let wanted = p0 + Vector3::new(0.0, 0.0, lift);
        let e = model.world_from_base.rotation.inverse() * (wanted - p);
        let j = model.arm.jacobian(&q, &model.tip_in_link).unwrap();
        let mut a = nalgebra::Matrix6x5::<f64>::zeros();
        a.copy_from(&j.fixed_view::<6, 5>(0, 0));
        let mut b = nalgebra::Vector6::zeros();
        b.fixed_rows_mut::<3>(0).copy_from(&e);
        let step = a.svd(true, true).solve(&b, 1e-9).unwrap();
        for i in 0..5 {
            q[i] += step[i];
        }
    }
    q
}

fn tip(model: &ArmModel, q: &[f64; 5]) -> (Vector3<f64>, Isometry3<f64>) {
    let pose = model.world_from_base * model.arm.forward(q).unwrap();
    ((pose * Point3::from(model.tip_in_link)).coords, pose)
}

/// Lowers the drives at 5 mm/s from `from` to `to` metres above `READY` while `go_on` says so.
fn lower(
    arm: &mut ArmPhysics,
    model: &ArmModel,
    from: f64,
    to: f64,
    mut go_on: impl FnMut(&ArmPhysics, usize) -> bool,
) -> usize {
    let steps = ((from - to) / 0.005 / model.step_s).round() as usize;
    let (a, b) = (rest_of(model, from), rest_of(model, to));
    for step in 1..=steps {
        let s = step as f64 / steps as f64;
        let rest: [f64; 5] = std::array::from_fn(|i| a[i] + s * (b[i] - a[i]));
        arm.set_rest(&rest);
        arm.step();
        if !go_on(arm, step) {
            return step;
        }
    }
    steps
}

#[test]
fn the_switch_closes_once_at_its_travel_with_the_springs_force() {
    let model = arm_model();
    let (positions, triangles) = floor(settled(&model, &READY).tip_in_world().z + 0.01, 60);
    let surface = StaticSurface {
        name: "floor".into(),
        positions: &positions,
        triangles: &triangles,
    };
    let mut arm = at_rest(&model, &[surface], &rest_of(&model, 0.02));
    let mut switch = Switch {
        closes_at_m: 0.002,
        opens_at_m: 0.0017,
        dead: false,
        closed: false,
    };
    let mut closings = Vec::new();
    let mut first_touch = None;
    let mut free_travel: f64 = 0.0;
    lower(&mut arm, &model, 0.02, 0.0065, |arm, step| {
        let touch = arm.contacts().tip;
        if step > 5 && touch.is_none() && first_touch.is_none() {
            free_travel = free_travel.max(arm.switch_travel_m().abs());
        }
        if let (Some(touch), None) = (touch, first_touch) {
            first_touch = Some(touch);
        }
        if switch.update(arm.switch_travel_m()) {
            closings.push((step, touch.unwrap().axial_force_n));
        }
        true
    });
    for _ in 0..500 {
        arm.step();
        switch.update(arm.switch_travel_m());
    }
    assert_eq!(closings.len(), 1);
    assert!(switch.closed);
    // spring 3.0 N at 2 mm, plunger's weight 0.2 N, damping 0.02 N, a little of the slant
    assert!((closings[0].1 - 3.2).abs() < 0.1, "{} N", closings[0].1);
    assert!(free_travel < 1e-6, "{free_travel} m");
    let touch = first_touch.unwrap();
    assert!(
        (touch.point_m.z - positions[0].z).abs() < 2e-5,
        "{}",
        touch.point_m.z
    );
    assert!(touch.normal.z > 0.999);
    assert!(arm.contacts().elsewhere.is_none());
}

#[test]
fn a_link_that_touches_the_ground_is_told_apart_from_the_tip() {
    let model = arm_model();
    let q = [0.125, -0.6, 1.8, -1.2, -1.57];
    let free = settled(&model, &q);
    let elbow = free.world_from_link(1).translation.vector;
    let (positions, triangles) = floor(
        elbow.z.min(free.world_from_link(2).translation.z) - 0.02,
        40,
    );
    let surface = StaticSurface {
        name: "floor".into(),
        positions: &positions,
        triangles: &triangles,
    };
    let mut arm = ArmPhysics::new(&model, &[surface], &q).unwrap();
    let mut most: Option<(usize, f64)> = None;
    for _ in 0..300 {
        arm.step();
        most = arm.contacts().elsewhere.or(most);
    }
    assert!(most.is_some_and(|(_, force)| force > 1.0), "{most:?}");
}

#[test]
fn the_same_motion_gives_the_same_bits() {
    let digest = || {
        let model = perturbed();
        let (positions, triangles) = floor(0.1, 80);
        let surface = StaticSurface {
            name: "floor".into(),
            positions: &positions,
            triangles: &triangles,
        };
        let mut arm = at_rest(&model, &[surface], &rest_of(&model, 0.02));
        let mut hash = 0xcbf2_9ce4_8422_2325_u64;
        lower(&mut arm, &model, 0.02, -0.01, |arm, _| {
            let (q, qd) = angles(arm);
            for x in q.iter().chain(&qd) {
                hash = (hash ^ x.to_bits()).wrapping_mul(0x0100_0000_01b3);
            }
            true
        });
        hash
    };
    assert_eq!(digest(), digest());
}
