//! Speed of the physics and of whole control steps: arm, driver, switch, terrain.
#![allow(clippy::unwrap_used, missing_docs)]

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use rover_kinematics::through;
use rover_messages::arm::Guard;
use rover_robot::Robot;
use rover_sim::{RockDescription, SimulationDescription, World};
use std::sync::Arc;

fn world() -> World {
    let text = include_str!("../../scenarios/robots/bluestreak.toml");
    let robot = Arc::new(Robot::parse(text, "bluestreak.toml").unwrap());
    let start = robot.posture("ready").unwrap().to_vec();
    let mut description = SimulationDescription::default();
    description.terrain.height_m = 0.25;
    description.terrain.rocks = vec![RockDescription {
        position_m: [0.54, 0.0, 0.27],
        ..RockDescription::default()
    }];
    World::new(robot, &description, 1, &start).unwrap()
}

fn steps(criterion: &mut Criterion) {
    const PERIODS: u32 = 50;
    let mut world = world();
    let steps = u64::from(PERIODS) * world.steps_per_period();
    let mut group = criterion.benchmark_group("control_steps");
    group.throughput(Throughput::Elements(steps));
    group.bench_function("holding", |b| b.iter(|| world.advance(PERIODS)));
    let robot = world.robot().clone();
    let (ready, stow) = (
        robot.posture("ready").unwrap(),
        robot.posture("stow").unwrap(),
    );
    let mut to_stow = true;
    group.bench_function("moving", |b| {
        b.iter(|| {
            if !world.is_moving() {
                let ends = if to_stow {
                    [ready, stow]
                } else {
                    [stow, ready]
                };
                to_stow = !to_stow;
                let path = ends.map(<[f64]>::to_vec);
                world
                    .start(through(&robot.arm, &path, 1.0).unwrap(), Guard::default())
                    .unwrap();
            }
            world.advance(PERIODS)
        });
    });
    group.finish();
}

criterion_group!(benches, steps);
criterion_main!(benches);
