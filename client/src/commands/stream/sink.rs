//! Where streamed frames go. A thread of its own unpacks and writes them: whoever reads a pipe may take his time, and meanwhile the
//! connection stays alive and Ctrl-C works.

use std::fmt;
use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;

use anyhow::Context as _;
use lumisphere::images::{ReadLimits, decode_image_codes};
use lumisphere_proto::v1alpha1 as wire;
use tokio::sync::{mpsc, oneshot};

use crate::commands::render::{file_contents, file_names};
use crate::files::{Existing, Growing, prepare_folder, write_atomically};
use crate::render_settings::OutputFlags;
use crate::video::{ColourFlags, FrameRate, VideoWriter};

/// Frames that wait to be written, one being written beside them: enough that rendering and writing overlap.
const WAITING: usize = 1;

/// `--out`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Destination {
    /// A file a frame.
    Folder(PathBuf),
    /// One file.
    Video(PathBuf),
    /// Standard output.
    Pipe,
}

impl From<std::ffi::OsString> for Destination {
    fn from(text: std::ffi::OsString) -> Self {
        let path = PathBuf::from(text);
        match path.extension() {
            _ if path.as_os_str() == "-" => Self::Pipe,
            Some(extension) if extension.eq_ignore_ascii_case("y4m") => Self::Video(path),
            _ => Self::Folder(path),
        }
    }
}

impl fmt::Display for Destination {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Folder(path) | Self::Video(path) => path.display().fmt(f),
            Self::Pipe => f.write_str("-"),
        }
    }
}

impl Destination {
    /// One y4m for all frames.
    pub fn is_video(&self) -> bool {
        !matches!(self, Self::Folder(_))
    }
}

/// Takes frames in order.
pub struct Sink {
    frames: mpsc::Sender<wire::Frame>,
    ended: oneshot::Receiver<anyhow::Result<()>>,
    bytes: Arc<AtomicU64>,
    /// The video's file, which appears at the end.
    growing: Option<Growing>,
}

/// Writes a frame, which is the so-manieth.
type WriteFrame = Box<dyn FnMut(u64, wire::Frame) -> anyhow::Result<()> + Send>;

/// Room for one frame.
pub struct Slot(mpsc::OwnedPermit<wire::Frame>);

impl Slot {
    /// Never waits.
    pub fn send(self, frame: wire::Frame) {
        self.0.send(frame);
    }
}

impl Sink {
    /// Refuses, before any work, to overwrite what shall be kept.
    pub fn open(
        to: &Destination,
        output: &OutputFlags,
        video: (FrameRate, ColourFlags),
        count: u64,
        existing: Existing,
    ) -> anyhow::Result<Self> {
        let bytes = Arc::new(AtomicU64::new(0));
        let counting = |to: Box<dyn Write + Send>| Counting { to, bytes: bytes.clone() };
        let (mut growing, output) = (None, output.clone());
        let write: WriteFrame = match to {
            Destination::Folder(folder) => {
                let names = (0..count).flat_map(|index| file_names(index, &output));
                prepare_folder(folder, names, existing)?;
                let (folder, bytes) = (folder.clone(), bytes.clone());
                Box::new(move |index, frame| {
                    let written = write_files(&folder, &file_names(index, &output), &frame, existing)?;
                    bytes.fetch_add(written, Ordering::Relaxed);
                    Ok(())
                })
            }
            Destination::Video(path) => {
                let file: File = growing.insert(Growing::create(path, existing)?).writer()?;
                video_writer(counting(Box::new(file)), video)
            }
            Destination::Pipe => video_writer(counting(Box::new(io::stdout())), video),
        };
        let (frames, mut waiting) = mpsc::channel::<wire::Frame>(WAITING);
        let (tell, ended) = oneshot::channel();
        thread::spawn(move || {
            let _ = tell.send(write_all(&mut waiting, write));
        });
        Ok(Self { frames, ended, bytes, growing })
    }

    /// Waits until there is room, or tells why there never will be.
    pub async fn slot(&mut self) -> anyhow::Result<Slot> {
        match self.frames.clone().reserve_owned().await {
            Ok(permit) => Ok(Slot(permit)),
            Err(_) => Err(self.end().await.err().unwrap_or_else(|| anyhow::anyhow!("the writer has ended"))),
        }
    }

    /// Waits until all is written; how many bytes that was.
    pub async fn finish(mut self) -> anyhow::Result<u64> {
        let (nowhere, _) = mpsc::channel(1);
        drop(std::mem::replace(&mut self.frames, nowhere));
        self.end().await?;
        if let Some(growing) = self.growing {
            growing.finish()?;
        }
        Ok(self.bytes.load(Ordering::Relaxed))
    }

    async fn end(&mut self) -> anyhow::Result<()> {
        (&mut self.ended).await.context("the writer panicked")?
    }
}

fn write_all(waiting: &mut mpsc::Receiver<wire::Frame>, mut write: WriteFrame) -> anyhow::Result<()> {
    let mut index = 0;
    while let Some(frame) = waiting.blocking_recv() {
        write(index, frame)?;
        index += 1;
    }
    Ok(())
}

fn write_files(folder: &Path, names: &[String], frame: &wire::Frame, existing: Existing) -> anyhow::Result<u64> {
    let mut written = 0;
    for (name, bytes) in names.iter().zip(file_contents(frame)) {
        write_atomically(&folder.join(name), bytes, existing)?;
        written += bytes.len() as u64;
    }
    Ok(written)
}

/// The first frame says how large the video is.
fn video_writer(to: Counting, (rate, colours): (FrameRate, ColourFlags)) -> WriteFrame {
    let (mut to, mut video) = (Some(to), None);
    Box::new(move |_, frame| {
        let picture = decode_image_codes(&frame.color, ReadLimits::SCENE).context("a frame from the server")?;
        if let Some(to) = to.take() {
            video = Some(VideoWriter::new(to, (picture.width, picture.height), rate, colours)?);
        }
        video.as_mut().map_or(Ok(()), |video| video.write(&picture))?;
        Ok(())
    })
}

/// Counts what goes through and holds nothing back: a player shows each frame when it is there.
struct Counting {
    to: Box<dyn Write + Send>,
    bytes: Arc<AtomicU64>,
}

impl Write for Counting {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.to.write(bytes)?;
        self.to.flush()?;
        self.bytes.fetch_add(written as u64, Ordering::Relaxed);
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.to.flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn out_is_a_pipe_a_video_or_a_folder() {
        let of = |text: &str| Destination::from(std::ffi::OsString::from(text));
        assert_eq!(of("-"), Destination::Pipe);
        assert_eq!([of("a/film.y4m"), of("b.Y4M")], [Destination::Video("a/film.y4m".into()), Destination::Video("b.Y4M".into())]);
        assert_eq!([of("frames"), of("./-"), of("y4m")], ["frames", "./-", "y4m"].map(|f| Destination::Folder(f.into())));
    }
}
