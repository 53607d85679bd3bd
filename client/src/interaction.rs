//! An `Interact` stream as its viewer sees it: poses up, frames down, a credit given back for each. `render --stream`, `stream` and `watch` use it.

use std::time::{Duration, Instant};

use anyhow::Context as _;
use lumisphere_proto::v1alpha1 as wire;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Status, Streaming};
use tonic_types::{ErrorDetails, StatusExt};
use wire::interact_request::Message as Up;
use wire::interact_response::Message as Down;

use crate::context::{Context, Server};
use crate::exit::Failure;

/// Messages on their way up: more than anyone types before a server that stalls is noticed. Who sends more waits.
const OUTBOX: usize = 1024;

/// The least time of so many calls is the round trip.
const ROUND_TRIPS: usize = 3;
/// Where each frame is awaited before the next pose: a coarse one, and the one that is final.
const PATH_CREDITS: u32 = 2;
/// The most that a server takes.
const MOST_CREDITS: f32 = 16.0;

/// An open stream; dropping it ends it.
pub struct Interaction {
    up: mpsc::Sender<wire::InteractRequest>,
    down: Streaming<wire::InteractResponse>,
}

/// What a viewer hears.
#[derive(Debug)]
pub enum Answer {
    /// Not acknowledged yet.
    Frame(Box<wire::Frame>),
    /// A message was refused or a frame failed; the stream goes on.
    Refused(Status),
}

/// Which frame of a pose is the one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wanted {
    /// None better follows.
    Final,
    /// Coarse levels may stand in for pages that are on their way.
    First,
}

impl Interaction {
    /// With as many credits as fill the way to the server at the rate that is asked for, few for a rate of 0. The server answers a bad opening with the first
    /// `next`.
    pub async fn open(context: &Context, server: &Server, mut open: wire::OpenInteraction) -> anyhow::Result<Self> {
        open.credits = match open.moving_frames_per_second {
            Some(rate) if rate > 0.0 => credits(round_trip(context, server).await?, rate),
            _ => PATH_CREDITS,
        };
        let (up, messages) = mpsc::channel(OUTBOX);
        let _ = up.send(wire::InteractRequest { message: Some(Up::Open(open)) }).await;
        let down = server.rendering().interact(context.patient_request(ReceiverStream::new(messages))).await?.into_inner();
        Ok(Self { up, down })
    }

    /// Looks from here from now on. `pose_id` from 1, increasing.
    pub async fn look(&self, pose_id: u64, camera: wire::Camera) {
        self.send(Up::Pose(wire::PoseUpdate { pose_id, camera: Some(camera) })).await;
    }

    /// Gives back the credits of this frame and all before it.
    pub async fn acknowledge(&self, frame: &wire::Frame) {
        self.send(Up::Acknowledge(wire::FrameAcknowledgement { frame_id: frame.frame_id })).await;
    }

    /// If the server has gone, the next answer says why; a failed send does not.
    async fn send(&self, message: Up) {
        let _ = self.up.send(wire::InteractRequest { message: Some(message) }).await;
    }

    /// What comes next. Cancelled, nothing is lost.
    pub async fn next(&mut self) -> anyhow::Result<Answer> {
        loop {
            let ended = || Failure::Unavailable("the server ended the stream".into());
            match self.down.message().await?.ok_or_else(ended)?.message {
                Some(Down::Frame(frame)) => return Ok(Answer::Frame(Box::new(frame))),
                Some(Down::Status(status)) => return Ok(Answer::Refused(status_of(status))),
                Some(Down::Opened(_)) | None => {}
            }
        }
    }

    /// The frame of this pose, acknowledged; those before it are acknowledged and dropped.
    pub async fn frame(&mut self, pose_id: u64, wanted: Wanted) -> anyhow::Result<wire::Frame> {
        loop {
            match self.next().await? {
                Answer::Refused(status) => return Err(status.into()),
                Answer::Frame(frame) => {
                    self.acknowledge(&frame).await;
                    if frame.pose_id == pose_id && (frame.is_final || wanted == Wanted::First) {
                        return Ok(*frame);
                    }
                }
            }
        }
    }

    /// Half-closes and waits for the server's end of the stream.
    pub async fn close(self) -> anyhow::Result<()> {
        let Self { up, mut down } = self;
        drop(up);
        while down.message().await.context("at the end of the stream")?.is_some() {}
        Ok(())
    }
}

/// One frame that is looked at, and those that come in a frame's round trip: the way's, and an interval each for drawing it and for sending it
/// where the link is just wide enough.
fn credits(round_trip: Duration, frames_per_second: f32) -> u32 {
    (3.0 + (round_trip.as_secs_f32() * frames_per_second).ceil()).min(MOST_CREDITS) as u32
}

/// To the server and back, without anything to carry.
async fn round_trip(context: &Context, server: &Server) -> anyhow::Result<Duration> {
    let mut least = Duration::MAX;
    for _ in 0..ROUND_TRIPS {
        let asked = Instant::now();
        server.system().measure_link(context.request(wire::MeasureLinkRequest::default())).await?;
        least = least.min(asked.elapsed());
    }
    Ok(least)
}

/// The same error that a unary call would give.
fn status_of(status: wire::InteractStatus) -> Status {
    let details = ErrorDetails::with_error_info(status.reason, lumisphere_proto::ERROR_DOMAIN, [] as [(String, String); 0]);
    Status::with_error_details(Code::from_i32(status.code), status.message, details)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn credits_fill_the_way_to_the_server_and_leave_one_frame_to_look_at() {
        let of = |millis, rate| credits(Duration::from_millis(millis), rate);
        assert_eq!([of(0, 30.0), of(33, 30.0), of(34, 30.0), of(100, 30.0), of(100, 12.0)], [3, 4, 5, 6, 5]);
        assert_eq!(of(10_000, 240.0), 16);
    }

    #[test]
    fn a_status_in_a_stream_has_the_exit_code_of_the_same_status_alone() {
        let status =
            wire::InteractStatus { code: Code::InvalidArgument as i32, reason: "FIELD_INVALID".into(), message: "no".into(), pose_id: 1 };
        assert_eq!(crate::exit::code(&status_of(status).into()), 2);
    }
}
