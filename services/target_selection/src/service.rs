//! Target selection on the network: `target/select` and `target/current`.

use crate::{SERVICE, check_pixel, check_reach, is_distant, target_at};
use rover_bus::{BusError, Peer, Stream};
use rover_messages::{
    Fault, keys,
    status::work,
    target::{SelectRequest, Target},
};
use rover_robot::Robot;
use rover_service::{Service, ServiceShell, frames};
use std::sync::Arc;

/// Starts the service on `peer`; it lives as long as the returned value.
///
/// # Errors
/// [`BusError`] when a key cannot be declared or the name is taken.
pub async fn serve(peer: &Peer, robot: Arc<Robot>) -> Result<Service, BusError> {
    let shell = ServiceShell::new(peer, &robot, SERVICE).await?;
    let desk = Arc::new(Desk {
        peer: peer.clone(),
        shell: shell.clone(),
        robot,
        current: peer.stream(keys::TARGET_CURRENT).await?,
    });
    let select = peer
        .serve(keys::TARGET_SELECT, move |request: SelectRequest| {
            let desk = desk.clone();
            async move { desk.select(request).await }
        })
        .await?;
    shell.start(vec![select]).await
}

struct Desk {
    peer: Peer,
    shell: ServiceShell,
    robot: Arc<Robot>,
    current: Stream<Target>,
}

impl Desk {
    async fn select(&self, request: SelectRequest) -> Result<Target, Fault> {
        let _activity = self.shell.activity("selecting");
        let target = self
            .shell
            .answered(self.selected(request).await, "targets")?;
        if let Err(error) = self.current.publish(target.clone()) {
            let fault = error.into_fault(SERVICE);
            self.shell
                .fault(&fault, "target answered but not published");
        }
        Ok(target)
    }

    async fn selected(&self, request: SelectRequest) -> Result<Target, Fault> {
        let pair = self
            .robot
            .pair(&request.pair)
            .map_err(|e| Fault::new(SERVICE, "unknown_name", e.to_string()))?
            .clone();
        check_pixel(request.pixel_px, &pair)?;
        let frame = frames::capture(&self.peer, SERVICE, &pair.name).await?;
        let (robot, shell) = (self.robot.clone(), self.shell.clone());
        tokio::task::spawn_blocking(move || {
            let target = shell.timed(work::VISION, || target_at(&request, &frame, &pair))?;
            if !is_distant(&pair) {
                check_reach(&robot, &target)?;
            }
            Ok(target)
        })
        .await
        .unwrap_or_else(|e| Err(Fault::new(SERVICE, "internal", e.to_string())))
    }
}
