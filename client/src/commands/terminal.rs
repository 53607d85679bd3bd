//! `lumisphere watch`: a dataset live in the terminal. Poses go up as keys come, the latest wins; frames come down as fast as the terminal
//! takes them, since each is acknowledged when it is drawn.

mod pictures;
mod questions;
mod screen;
mod steering;

use std::io::{self, IsTerminal, Write};
use std::pin::Pin;
use std::thread;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use clap::Args;
use crossterm::event::Event;
use lumisphere_proto::v1alpha1 as wire;
use tokio::sync::mpsc;

use crate::commands::render::version_of;
use crate::context::{Context, Server};
use crate::exit::{Failure, is_broken_connection};
use crate::interaction::{Answer, Interaction, Wanted};
use crate::render_settings::{SettingsFlags, with_uploads};
use pictures::{Area, Effort, Lines, Protocol, USUAL_CELL_PX};
use questions::{Answers, ask, sane};
use screen::{Raw, Screen};
use steering::{Reaction, Steering, Viewpoint, radius};

/// Events that wait while a picture is drawn.
const WAITING_EVENTS: usize = 256;
/// Of a picture that is printed: a cell is hundreds of its pixels.
const MOST_CELLS: u32 = 64_000;
/// Of a terminal that tells no size, and of a pipe.
const USUAL_CELLS: Cells = Cells { columns: 80, rows: 24 };
/// Between attempts to reach a server that is away.
const PAUSE: Duration = Duration::from_millis(500);
const HELP: &str = "arrows or drag turn, WASD move, +/- or wheel nearer/farther, r reset, q quit";

/// Flags of `watch`.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Dataset to look at
    #[arg(value_name = "DATASET")]
    dataset: String,
    /// Which version [default: the latest]
    #[arg(long, default_value_t = 0, hide_default_value = true)]
    version: u64,
    /// How pictures reach the screen [default: the first of these that the terminal says it can]
    #[arg(long, value_enum)]
    protocol: Option<Protocol>,
    /// Print one frame and end
    #[arg(long)]
    once: bool,
    /// Of that one, in characters [default: the terminal's but its last row, else 80x24]
    #[arg(long, value_name = "COLUMNSxROWS", requires = "once")]
    cells: Option<Cells>,
    /// Frames a second while the camera moves: they are made smaller until they come so fast; 0: always full size
    #[arg(long, value_name = "HZ", default_value_t = 30.0)]
    rate: f32,
    /// Field of view across the shorter side
    #[arg(long, value_name = "DEGREES", default_value_t = 40.0)]
    fov_deg: f32,
    /// Where to begin: above the horizon
    #[arg(long, value_name = "DEGREES", default_value_t = 25.0, allow_negative_numbers = true)]
    elevation_deg: f32,
    /// Where to begin: from the object's centre, in radii of its bounding sphere
    #[arg(long, value_name = "RADII", default_value_t = 3.5)]
    distance_radii: f32,
    /// Where to begin: from +Z toward +X
    #[arg(long, value_name = "DEGREES", default_value_t = 0.0, allow_negative_numbers = true)]
    azimuth_deg: f32,
    /// Shows radiance · 2^STOPS
    #[arg(long, value_name = "STOPS", default_value_t = 0.0, allow_negative_numbers = true)]
    exposure_stops: f32,
    /// Shows 1 − exp(−GAMMA · radiance · 2^STOPS), which never clips, 0 to 1000; 0 for none
    #[arg(long, value_name = "GAMMA", default_value_t = 0.0)]
    gamma: f32,
    /// How long the server may be away before the viewer gives up
    #[arg(long, value_name = "SECONDS", default_value_t = 60)]
    patience: u32,
    #[command(flatten)]
    settings: SettingsFlags,
}

/// A size in characters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Cells {
    columns: u16,
    rows: u16,
}

impl std::str::FromStr for Cells {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let side = |text: &str| text.parse().ok().filter(|side| (1..=1000).contains(side));
        let cells = text.split_once('x').and_then(|(columns, rows)| Some(Self { columns: side(columns)?, rows: side(rows)? }));
        let cells = cells.filter(|cells| u32::from(cells.columns) * u32::from(cells.rows) <= MOST_CELLS);
        cells.ok_or_else(|| format!("COLUMNSxROWS expected, each 1 to 1000, {MOST_CELLS} together at most, such as 80x24"))
    }
}

/// Looks until the viewer has seen enough.
pub async fn run(arguments: &Arguments, context: &Context) -> anyhow::Result<()> {
    let is_terminal = io::stdout().is_terminal();
    check(arguments, is_terminal)?;
    let server = context.connect().await?;
    let (version, kind) = version_of(context, &server, &arguments.dataset, arguments.version).await?;
    let bounds = version.object_bounds.filter(|bounds| radius(bounds).is_finite());
    let bounds = bounds.ok_or_else(|| Failure::Precondition("the dataset tells no object's box to look at".into()))?;
    let open = wire::OpenInteraction {
        dataset: arguments.dataset.clone(),
        version: version.version,
        settings: Some(with_uploads(arguments.settings.to_wire(&kind), context).await?),
        output: Some(wire::OutputSettings {
            encoding: wire::Encoding::Png.into(),
            exposure_stops: arguments.exposure_stops,
            exposure_gamma: arguments.gamma,
            ..Default::default()
        }),
        moving_frames_per_second: Some(if arguments.once { 0.0 } else { arguments.rate }),
        // The opening's to know.
        credits: 0,
    };
    let Arguments { azimuth_deg, elevation_deg, distance_radii, fov_deg, .. } = *arguments;
    let home = Viewpoint::around(&bounds, azimuth_deg, elevation_deg, distance_radii, fov_deg);
    if arguments.once {
        // Heard from now on, acted upon once the terminal has answered and is as it was.
        let mut ends = Ends::listen()?;
        return tokio::select! {
            biased;
            printed = print_once(arguments, context, &server, open, &home, is_terminal) => printed,
            () = ends.come() => Err(Failure::Interrupted { note: None }.into()),
        };
    }
    let title = format!("{} v{}", arguments.dataset, version.version);
    let interaction = Interaction::open(context, &server, open.clone()).await?;
    let patience = Duration::from_secs(arguments.patience.into());
    let reopen = |lost| -> Reopening<'_> { Box::pin(reopen(context, &server, open.clone(), lost, patience)) };
    Live::begin(arguments, interaction, Steering::new(home, radius(&bounds)), title)?.run(patience, &reopen).await
}

/// What the server would not refuse.
fn check(arguments: &Arguments, is_terminal: bool) -> Result<(), Failure> {
    let Arguments { elevation_deg, distance_radii, azimuth_deg, fov_deg, .. } = *arguments;
    if !arguments.once && !is_terminal {
        let problem = "standard output is no terminal; `lumisphere stream` writes frames to files and pipes, `watch --once` one picture";
        return Err(Failure::Usage(problem.into()));
    }
    if !is_terminal && arguments.protocol.is_none() {
        return Err(Failure::Usage("standard output is no terminal that could be asked: --protocol must say how to print".into()));
    }
    for (flag, value, least, most) in [
        ("fov-deg", fov_deg, 5.0, 120.0),
        ("elevation-deg", elevation_deg, -90.0, 90.0),
        ("distance-radii", distance_radii, 0.02, 200.0),
        ("azimuth-deg", azimuth_deg, -360.0, 360.0),
    ] {
        if !(value >= least && value <= most) {
            return Err(Failure::Usage(format!("--{flag} is {value}, {least} to {most} expected")));
        }
    }
    Ok(())
}

/// The first that it can; half blocks need nothing but colours.
fn best(answers: Answers) -> Protocol {
    match answers {
        Answers { kitty: true, .. } => Protocol::Kitty,
        Answers { sixel: true, .. } => Protocol::Sixel,
        _ => Protocol::HalfBlocks,
    }
}

/// Of the terminal; `said`: what it answered.
fn cell_px(said: Answers) -> (u32, u32) {
    let by_window = crossterm::terminal::window_size().ok().and_then(|w| {
        let side = |px: u16, cells: u16| u32::from(px).checked_div(u32::from(cells)).filter(|side| sane(*side));
        Some((side(w.width, w.columns)?, side(w.height, w.rows)?))
    });
    by_window.or(said.cell_px).unwrap_or(USUAL_CELL_PX)
}

/// Of the terminal, all of it.
fn cells() -> Cells {
    let told = crossterm::terminal::size().ok().filter(|(columns, rows)| *columns > 0 && *rows > 0);
    told.map_or(USUAL_CELLS, |(columns, rows)| Cells { columns, rows })
}

async fn print_once(
    arguments: &Arguments,
    context: &Context,
    server: &Server,
    open: wire::OpenInteraction,
    home: &Viewpoint,
    is_terminal: bool,
) -> anyhow::Result<()> {
    let (protocol, cell_px, cells) = if is_terminal {
        let answers = {
            let _raw = Raw::take()?;
            ask()?
        };
        let Cells { columns, rows } = cells();
        // The prompt comes below.
        let all_but_one = Cells { columns, rows: (rows - 1).max(1) };
        (arguments.protocol.unwrap_or(best(answers)), cell_px(answers), all_but_one)
    } else {
        (arguments.protocol.unwrap_or(Protocol::HalfBlocks), USUAL_CELL_PX, USUAL_CELLS)
    };
    let Cells { columns, rows } = arguments.cells.unwrap_or(cells);
    let area = Area { columns, rows, cell_px };
    let mut interaction = Interaction::open(context, server, open).await?;
    interaction.look(1, home.camera(protocol.frame_size(area))).await;
    let frame = interaction.frame(1, Wanted::Final).await?;
    interaction.close().await?;
    let mut picture = protocol.picture(&frame.color, area, Effort::Full, Lines::Flowing)?;
    if protocol != Protocol::HalfBlocks {
        picture.push(b'\n');
    }
    let mut out = io::stdout().lock();
    out.write_all(&picture)?;
    out.flush()?;
    Ok(())
}

/// An attempt to open the interaction once more.
type Reopening<'a> = Pin<Box<dyn Future<Output = anyhow::Result<Interaction>> + 'a>>;

/// Tries until the server is back, or has been away since `lost` for too long.
async fn reopen(
    context: &Context,
    server: &Server,
    open: wire::OpenInteraction,
    lost: Instant,
    patience: Duration,
) -> anyhow::Result<Interaction> {
    loop {
        // A server that takes the stream and ends it at once is not asked all the time either.
        tokio::time::sleep(PAUSE.min(patience)).await;
        match Interaction::open(context, server, open.clone()).await {
            Err(error) if goes_away(&error) && lost.elapsed() < patience => {}
            opened => return opened,
        }
    }
}

/// A broken connection, or the place of the one that broke, which the server has not noticed yet.
fn goes_away(error: &anyhow::Error) -> bool {
    let is_full = |status: &tonic::Status| crate::exit::reason(status) == "TOO_MANY_SESSIONS";
    is_broken_connection(error) || error.downcast_ref::<tonic::Status>().is_some_and(is_full)
}

/// A viewer at a terminal.
struct Live {
    ends: Ends,
    interaction: Interaction,
    screen: Screen,
    protocol: Protocol,
    answers: Answers,
    cells: Cells,
    steering: Steering,
    title: String,
    pose_id: u64,
    /// Of the latest pose.
    asked: Instant,
    /// What the last frame or refusal says.
    news: String,
}

/// Signals that end the process.
struct Ends {
    #[cfg(unix)]
    signals: [tokio::signal::unix::Signal; 2],
}

impl Ends {
    #[cfg(unix)]
    fn listen() -> io::Result<Self> {
        use tokio::signal::unix::{SignalKind, signal};
        Ok(Self { signals: [signal(SignalKind::terminate())?, signal(SignalKind::hangup())?] })
    }

    #[cfg(not(unix))]
    fn listen() -> io::Result<Self> {
        Ok(Self {})
    }

    async fn come(&mut self) {
        #[cfg(unix)]
        {
            let [terminate, hangup] = &mut self.signals;
            tokio::select! {
                _ = terminate.recv() => {}
                _ = hangup.recv() => {}
            }
        }
        #[cfg(not(unix))]
        std::future::pending::<()>().await;
    }
}

/// Events from a thread that ends with the process: reading a terminal cannot be called off.
fn events() -> mpsc::Receiver<io::Result<Event>> {
    let (tell, events) = mpsc::channel(WAITING_EVENTS);
    thread::spawn(move || {
        loop {
            let event = crossterm::event::read();
            let is_end = event.is_err();
            if tell.blocking_send(event).is_err() || is_end {
                return;
            }
        }
    });
    events
}

impl Live {
    /// Takes the terminal and asks it.
    fn begin(arguments: &Arguments, interaction: Interaction, steering: Steering, title: String) -> anyhow::Result<Self> {
        // Before anything that a signal must not leave as it is.
        let ends = Ends::listen()?;
        let screen = Screen::take().context("cannot take the terminal")?;
        let answers = ask().context("cannot ask the terminal")?;
        let protocol = arguments.protocol.unwrap_or(best(answers));
        if protocol == Protocol::Kitty {
            screen.has_pictures();
        }
        let (asked, news) = (Instant::now(), String::new());
        Ok(Self { ends, interaction, screen, protocol, answers, cells: cells(), steering, title, pose_id: 0, asked, news })
    }

    async fn run<'a>(mut self, patience: Duration, reopen: &dyn Fn(Instant) -> Reopening<'a>) -> anyhow::Result<()> {
        let mut events = events();
        // While the connection is lost.
        let mut reopening: Option<Reopening<'a>> = None;
        // Since the last frame.
        let mut lost: Option<Instant> = None;
        self.screen.clear()?;
        self.look().await;
        self.show(&[])?;
        loop {
            tokio::select! {
                () = self.ends.come() => return Err(Failure::Interrupted { note: None }.into()),
                event = events.recv() => {
                    // All that have come: only the place where they lead to is worth a frame.
                    let (mut has_moved, mut next) = (false, event);
                    while let Some(event) = next {
                        match self.take(&event.context("cannot read the terminal")?)? {
                            Reaction::Nothing => {}
                            Reaction::Moved | Reaction::Resized => has_moved = true,
                            Reaction::Quit => return Ok(()),
                            Reaction::Interrupted => return Err(Failure::Interrupted { note: None }.into()),
                        }
                        next = events.try_recv().ok();
                    }
                    if has_moved {
                        self.look().await;
                    }
                }
                answer = self.interaction.next(), if reopening.is_none() => match answer {
                    Ok(Answer::Frame(frame)) => {
                        lost = None;
                        self.draw(&frame)?;
                        self.interaction.acknowledge(&frame).await;
                    }
                    Ok(Answer::Refused(status)) => {
                        self.news = format!("{} ({})", status.message(), crate::exit::code_name(status.code()));
                        self.show(&[])?;
                    }
                    Err(error) if goes_away(&error) && lost.is_none_or(|lost| lost.elapsed() < patience) => {
                        reopening = Some(reopen(*lost.get_or_insert_with(Instant::now)));
                        self.news = "reconnecting".into();
                        self.show(&[])?;
                    }
                    Err(error) => return Err(error),
                },
                opened = async { reopening.as_mut().expect("checked before").await }, if reopening.is_some() => {
                    reopening = None;
                    self.interaction = opened?;
                    // From where the viewer is by now.
                    self.look().await;
                }
            }
        }
    }

    /// All rows but the last, which says what is shown.
    fn area(&self) -> Area {
        let Cells { columns, rows } = self.cells;
        Area { columns, rows: (rows - 1).max(1), cell_px: cell_px(self.answers) }
    }

    fn take(&mut self, event: &Event) -> io::Result<Reaction> {
        let area = self.area();
        let reaction = self.steering.take(event, self.protocol.frame_size(area), self.protocol.cell_in_frame(area));
        if reaction == Reaction::Resized {
            self.cells = cells();
            self.screen.clear()?;
        }
        Ok(reaction)
    }

    /// From here, in the size that the terminal has now.
    async fn look(&mut self) {
        self.pose_id += 1;
        self.asked = Instant::now();
        // What was said of the last pose does not hold for this one.
        self.news = "moving".into();
        let camera = self.steering.view().camera(self.protocol.frame_size(self.area()));
        self.interaction.look(self.pose_id, camera).await;
    }

    fn draw(&mut self, frame: &wire::Frame) -> anyhow::Result<()> {
        let effort = if frame.is_final { Effort::Full } else { Effort::Little };
        let picture = self.protocol.picture(&frame.color, self.area(), effort, Lines::Placed)?;
        // Of an older pose it would say too much.
        if frame.pose_id == self.pose_id {
            let state = if frame.is_final { "final" } else { "moving" };
            self.news = format!("{}x{} {state} {}", frame.width_px, frame.height_px, millis(self.asked.elapsed()));
        }
        Ok(self.show(&picture)?)
    }

    fn show(&self, picture: &[u8]) -> io::Result<()> {
        let view = self.steering.view();
        let place = format!("az {:.0}° el {:.0}°", view.azimuth_deg, view.elevation_deg);
        let status = format!("{} · {} · {place} · {HELP}", self.title, self.news);
        let status: String = status.chars().filter(|c| !c.is_control()).take(self.cells.columns.into()).collect();
        self.screen.show(picture, &status, self.cells.rows - 1)
    }
}

fn millis(time: Duration) -> String {
    format!("{:.0} ms", 1e3 * time.as_secs_f64())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_protocol_is_kittys_then_sixel_then_half_blocks() {
        let nothing = Answers::default();
        assert_eq!(best(nothing), Protocol::HalfBlocks);
        assert_eq!(best(Answers { sixel: true, ..nothing }), Protocol::Sixel);
        assert_eq!(best(Answers { sixel: true, kitty: true, ..nothing }), Protocol::Kitty);
    }

    #[test]
    fn sizes_in_characters_are_parsed_or_refused() {
        assert_eq!("80x24".parse(), Ok(Cells { columns: 80, rows: 24 }));
        for bad in ["80", "0x1", "1x1001", "1000x65", "x", "80x24x1", "-1x2"] {
            assert!(bad.parse::<Cells>().is_err(), "{bad}");
        }
    }
}
