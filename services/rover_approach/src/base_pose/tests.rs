#![allow(clippy::unwrap_used, clippy::expect_used)]
use super::*;
use crate::obstacles::tests::ground;

fn robot() -> Robot {
    let text = include_str!("../../../../scenarios/robots/rocky8.toml");
    Robot::parse(text, "rocky8.toml").unwrap()
}

fn choose(target: [f64; 3], normal: [f64; 3], map: &GroundMap) -> Result<BaseChoice, NoBase> {
    choose_another(target, normal, map, Vec::new())
}

fn choose_another(
    target: [f64; 3],
    normal: [f64; 3],
    map: &GroundMap,
    avoid: Vec<PlanarPose>,
) -> Result<BaseChoice, NoBase> {
    let robot = robot();
    let task = BaseTask {
        robot: &robot,
        mobility: robot.mobility().unwrap(),
        body: robot.pair("body").unwrap(),
        rules: &BaseRules::default(),
        shade: &Shade::of(&robot, robot.posture("stow").unwrap()),
        sun: None,
        avoid,
    };
    let spot = TargetSpot {
        position_m: target.into(),
        normal: Vector3::from(normal).normalize(),
        around_m: Vec::new(),
    };
    let choice = task.choose(&spot, map);
    if let Ok(choice) = &choice {
        // what was promised holds: the tip is on the target with the axis along the normal
        for s in choice.serving.iter().step_by(7) {
            let standing = s.standing.unwrap();
            let there = placed(&s.pose, &standing);
            let (tip, axis) = robot.tool.at(&robot.arm, &s.joints_rad).unwrap();
            let base = there * robot.rover_from_arm_base.isometry;
            let tip = (base * Point3::from(tip)).coords;
            assert!((tip - spot.position_m).norm() < 1e-6);
            assert!((base.rotation * axis.into_inner() + spot.normal).norm() < 1e-5);
            robot.arm.check_limits(&s.joints_rad).unwrap();
        }
    }
    choice
}

#[test]
fn a_pose_tried_in_vain_and_all_like_it_are_not_chosen_again() {
    let flat = ground(|_, _| 0.0);
    let (target, normal) = ([2.2, 0.1, 0.0], [0.0, 0.0, 1.0]);
    let tried = choose(target, normal, &flat).unwrap().serving[0].pose;
    let again = choose_another(target, normal, &flat, vec![tried]).unwrap();
    assert!(again.refused["tried_before"] > 0);
    for s in &again.serving {
        let away_m = (s.pose.x_m - tried.x_m).hypot(s.pose.y_m - tried.y_m);
        let turned_rad = (s.pose.heading_rad - tried.heading_rad).abs();
        assert!(away_m >= 0.2 || turned_rad >= 0.3, "{s:?}");
    }
}

#[test]
fn the_arm_that_serves_keeps_off_the_ground_but_for_its_tool() {
    let choice = choose([2.2, 0.1, 0.0], [0.0, 0.0, 1.0], &ground(|_, _| 0.0)).unwrap();
    let robot = robot();
    for s in choice.serving.iter().step_by(5) {
        let frames = robot.arm.link_poses(&s.joints_rad).unwrap();
        let joints = &robot.description().arm.joints;
        for (frame, joint) in frames.iter().skip(1).zip(joints).take(4).skip(1) {
            for shape in &joint.shape {
                for end in [shape.from_m, shape.to_m] {
                    let at = robot.rover_from_arm_base.isometry * frame * Point3::from(end);
                    assert!(at.z >= shape.radius_m, "{at} {shape:?}");
                }
            }
        }
    }
}

#[test]
fn a_target_on_open_ground_is_served_from_near_in_front_of_it() {
    let choice = choose([2.2, 0.1, 0.0], [0.0, 0.0, 1.0], &ground(|_, _| 0.0)).unwrap();
    let best = &choice.serving[0];
    assert!((0.7..1.3).contains(&best.target_m.x), "{best:?}");
    assert!(choice.serving.windows(2).all(|w| w[0].score >= w[1].score));
}

#[test]
fn a_rock_in_front_moves_the_base_aside() {
    let open = ground(|_, _| 0.0);
    let rock = ground(|x, y| {
        if f64::hypot(x - 1.3, y - 0.35) < 0.12 {
            0.4
        } else {
            0.0
        }
    });
    let free = choose([2.2, 0.0, 0.0], [0.0, 0.0, 1.0], &open).unwrap();
    let beside = choose([2.2, 0.0, 0.0], [0.0, 0.0, 1.0], &rock).unwrap();
    assert!(beside.serving.len() < free.serving.len());
    assert!(beside.refused.contains_key("obstacle") || beside.refused.contains_key("step"));
}

#[test]
fn what_cannot_be_served_says_why() {
    let open = ground(|_, _| 0.0);
    let away = choose([2.2, 0.0, 0.2], [1.0, 0.0, 0.0], &open).unwrap_err();
    assert!(away.to_string().contains("none of"), "{away}");
    let high = choose([2.2, 0.0, 1.6], [0.0, 0.0, 1.0], &open).unwrap_err();
    assert!(high.refused.contains_key("target_out_of_view"), "{high}");
    let steep = ground(|x, _| 0.5 * x);
    let slope = choose([2.2, 0.0, 1.1], [-0.45, 0.0, 0.9], &steep).unwrap_err();
    assert_eq!(slope.refused.keys().collect::<Vec<_>>(), ["slope"]);
}
