//! The parts of a system by name.

use super::{LaunchError, part_names};
use crate::scenario::LoadedScenario;
use rover_bus::Peer;
use rover_messages::keys::service;
use rover_robot::Robot;
use std::{any::Any, sync::Arc};

/// A running part; it ends when this is dropped.
#[must_use = "the part ends when this is dropped"]
pub struct Part(#[allow(dead_code, reason = "kept for its drop")] Box<dyn Any + Send>);

/// Puts the service of that name on the network.
///
/// # Errors
/// [`LaunchError::UnknownService`] with the names there are, [`LaunchError::Bus`].
pub async fn serve_service(
    name: &str,
    peer: &Peer,
    robot: Arc<Robot>,
) -> Result<Part, LaunchError> {
    let error = LaunchError::bus(name);
    let running = match name {
        service::MAST_IMAGING => rover_mast_imaging::serve(peer, robot).await,
        service::TARGET_SELECTION => rover_target_selection::serve(peer, robot).await,
        service::ROVER_APPROACH => rover_approach::service::serve(peer, robot).await,
        service::ARM_PLANNER => rover_arm_planner::serve(peer, robot).await,
        service::EPEC_SERVO => rover_epec_servo::serve(peer, robot).await,
        service::CONTACT_APPROACH => rover_contact_approach::serve(peer, robot).await,
        _ => {
            return Err(LaunchError::UnknownService {
                name: name.into(),
                known: part_names().collect::<Vec<_>>().join(", "),
            });
        }
    };
    Ok(Part(Box::new(running.map_err(error)?)))
}

/// Puts the simulated hardware on the network.
///
/// # Errors
/// [`LaunchError::World`] for a world that cannot be, [`LaunchError::Bus`].
pub async fn serve_hardware(
    peer: &Peer,
    loaded: &LoadedScenario,
    realtime: bool,
) -> Result<Part, LaunchError> {
    let world = loaded.clone();
    // Building meshes and ray tables takes a while of pure computing.
    let world = tokio::task::spawn_blocking(move || world.world())
        .await
        .map_err(|e| LaunchError::process(service::HARDWARE, e.to_string()))??;
    let options = rover_sim::hardware::Options {
        realtime,
        ..Default::default()
    };
    let running = rover_sim::hardware::serve(peer, world, options)
        .await
        .map_err(LaunchError::bus(service::HARDWARE))?;
    Ok(Part(Box::new(running)))
}
