//! `lumisphere watch`: what a terminal gets, and that it is given back. The tests are the terminal, at the other end of a pseudo-terminal.

use std::fs::File;
use std::io::{Read, Write};
use std::num::NonZeroU16;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc;
use std::thread;

use base64::Engine as _;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{Winsize, tcsetwinsize};
use vt100::{Color, MouseProtocolMode, Parser};

use crate::pictures::{Picture, rendered};
use crate::process::{PATIENCE, Server, binary, ended, temporary_folder, without_settings};
use crate::relay::Relay;
use crate::tiny::{self, DATASET};

/// What the tests' terminals answer to the question for their attributes, which comes last.
const PLAIN: &str = "\x1b[?62;22c";
const WITH_SIXEL: &str = "\x1b[?62;4;22c";
const WITH_KITTY: &str = "\x1b_Gi=31;OK\x1b\\\x1b[6;20;10t\x1b[?62c";
/// As much of it as must be there.
const LAST_QUESTION: &[u8] = b"\x1b[c";

/// The shell from which the client is called: the terminal's settings before and after, the client's exit code. It outlives signals to all.
const SHELL: &str = r#"trap : INT TERM; stty -g | cksum; "$@"; code=$?; stty -g | cksum; exit $code"#;

/// A terminal in which the client runs.
struct Terminal {
    master: File,
    /// The shell, and the leader of its group.
    child: Child,
    output: mpsc::Receiver<Vec<u8>>,
    emulator: Parser,
    /// All that was written to it.
    written: Vec<u8>,
}

fn emulator(columns: u16, rows: u16) -> Parser {
    let [rows, columns] = [rows, columns].map(|side| NonZeroU16::new(side).unwrap());
    Parser::new(rows, columns, 0)
}

fn winsize(columns: u16, rows: u16) -> Winsize {
    Winsize { ws_col: columns, ws_row: rows, ws_xpixel: 0, ws_ypixel: 0 }
}

impl Terminal {
    /// Runs `lumisphere` in a new session whose terminal this is.
    fn run(server: &Server, columns: u16, rows: u16, arguments: &[&str]) -> Self {
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
        grantpt(&master).unwrap();
        unlockpt(&master).unwrap();
        let name = ptsname(&master, Vec::new()).unwrap();
        tcsetwinsize(&master, winsize(columns, rows)).unwrap();
        let slave = File::options().read(true).write(true).open(name.to_str().unwrap()).unwrap();
        let mut command = Command::new("setsid");
        command.args(["--ctty", "sh", "-c", SHELL, "sh"]).arg(binary("lumisphere")).args(arguments);
        without_settings(&mut command);
        server.introduce(&mut command);
        command.env("TERM", "xterm-256color");
        let stdio = || Stdio::from(slave.try_clone().unwrap());
        let child = command.stdin(stdio()).stdout(stdio()).stderr(stdio()).spawn().expect("setsid (util-linux) is there");
        let master = File::from(master);
        let (tell, output) = mpsc::channel();
        let mut reader = master.try_clone().unwrap();
        thread::spawn(move || {
            let mut bytes = [0; 65536];
            while let Ok(count) = reader.read(&mut bytes) {
                if count == 0 || tell.send(bytes[..count].to_vec()).is_err() {
                    return;
                }
            }
        });
        Self { master, child, output, emulator: emulator(columns, rows), written: Vec::new() }
    }

    /// The same with a tiny dataset on its screen; it has answered what it can.
    fn watch(server: &Server, columns: u16, rows: u16, answer: &str, flags: &[&str]) -> Self {
        let mut terminal = Self::run(server, columns, rows, &[&["watch", DATASET], flags].concat());
        terminal.answer(answer);
        terminal
    }

    fn answer(&mut self, answer: &str) {
        self.wait("the question", |t| t.written.windows(LAST_QUESTION.len()).any(|w| w == LAST_QUESTION));
        self.press(answer);
    }

    fn press(&mut self, keys: &str) {
        self.master.write_all(keys.as_bytes()).unwrap();
    }

    fn resize(&mut self, columns: u16, rows: u16) {
        let [emulated_rows, emulated_columns] = [rows, columns].map(|side| NonZeroU16::new(side).unwrap());
        self.emulator.set_size(emulated_rows, emulated_columns);
        // The kernel tells the client.
        tcsetwinsize(&self.master, winsize(columns, rows)).unwrap();
    }

    /// Takes what is written until it is so.
    fn wait(&mut self, what: &str, is_so: impl Fn(&Self) -> bool) {
        while !is_so(self) {
            let Ok(bytes) = self.output.recv_timeout(PATIENCE) else {
                panic!("no {what}; the screen:\n{}", self.emulator.screen().contents())
            };
            self.take(&bytes);
        }
    }

    fn take(&mut self, bytes: &[u8]) {
        self.emulator.process(bytes);
        self.written.extend_from_slice(bytes);
    }

    /// Waits for a last row that has all of these words.
    fn wait_for_status(&mut self, words: &[&str]) {
        self.wait(&words.join(" "), |t| {
            let rows = t.emulator.screen().size().0.get();
            let last = t.emulator.screen().rows(0, 200).nth(usize::from(rows) - 1).unwrap_or_default();
            words.iter().all(|word| last.contains(word))
        });
    }

    /// The half blocks of all rows but the last: two pixels each.
    fn picture(&self) -> Picture {
        let screen = self.emulator.screen();
        let (rows, columns) = (screen.size().0.get(), screen.size().1.get());
        let mut pixels = Vec::new();
        for row in 0..rows - 1 {
            for is_lower in [false, true] {
                for column in 0..columns {
                    let cell = screen.cell(row, column).unwrap();
                    assert_eq!(cell.contents(), "▀", "row {row}, column {column}");
                    let Color::Rgb(r, g, b) = (if is_lower { cell.bgcolor() } else { cell.fgcolor() }) else {
                        panic!("no 24-bit colour at row {row}, column {column}")
                    };
                    pixels.push([r, g, b].map(f32::from));
                }
            }
        }
        Picture { width: columns.into(), pixels }
    }

    /// A signal to the shell and the client.
    fn signal(&self, name: &str) {
        let sent = Command::new("sh").args(["-c", &format!("kill -{name} -{}", self.child.id())]).status().unwrap();
        assert!(sent.success(), "the client has ended already");
    }

    /// Waits for the end; the terminal is as it was, and this was said on its own screen.
    fn given_back(mut self) -> (i32, String) {
        let code = ended(&mut self.child).expect("the client hung").code().expect("the shell tells the code");
        // Nobody holds the other end any more: what was written ends here.
        while let Ok(bytes) = self.output.recv_timeout(PATIENCE) {
            self.take(&bytes);
        }
        let screen = self.emulator.screen();
        assert!(!screen.alternate_screen() && !screen.hide_cursor(), "the other screen is left on, or the cursor off");
        assert_eq!(screen.mouse_protocol_mode(), MouseProtocolMode::None);
        let lines: Vec<String> = screen.contents().lines().map(str::to_string).collect();
        let [before, said @ .., after] = &lines[..] else { panic!("{lines:?}") };
        assert_eq!(before, after, "the line discipline is another");
        (code, said.join("\n"))
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn with_dataset() -> (tempfile::TempDir, Server) {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    (folder, server)
}

/// What `render` shows from here; its field of view is across the height, which is the shorter side of all pictures here.
fn truth(server: &Server, folder: &tempfile::TempDir, size: &str, azimuth_deg: &str) -> Picture {
    let flags = ["--frames", "1", "--size", size, "--azimuth-deg", azimuth_deg];
    Picture::of_png(&rendered(server, folder.path(), &flags)[0])
}

/// The mean difference of two pictures from the same place, of a camera whose last bits differ: a code rounds the other way now and then.
const SAME: f32 = 0.1;
/// And of two from places that are some degrees apart, at least.
const ANOTHER: f32 = 1.0;

#[test]
fn half_blocks_follow_keys_mouse_and_size_and_the_terminal_is_given_back() {
    let (folder, server) = with_dataset();
    let mut terminal = Terminal::watch(&server, 80, 25, PLAIN, &["--fov-deg", "40"]);
    let expect = |terminal: &mut Terminal, azimuth: &str, size: &str| {
        terminal.wait_for_status(&[&format!("az {azimuth}°"), &format!("{size} final")]);
        let picture = terminal.picture();
        let is = |azimuth: &str| picture.mean(&truth(&server, &folder, size, azimuth));
        assert!(is(azimuth) < SAME, "{azimuth}, {size}: {}", is(azimuth));
        let opposite = if azimuth == "40" { "0" } else { "40" };
        assert!(is(opposite) > ANOTHER, "{azimuth} and {opposite} look the same: {}", is(opposite));
    };
    expect(&mut terminal, "0", "80x48");
    assert!(terminal.emulator.screen().alternate_screen() && terminal.emulator.screen().hide_cursor());
    // Three times to the right.
    terminal.press("\x1b[C\x1b[C\x1b[C");
    expect(&mut terminal, "15", "80x48");
    terminal.resize(60, 13);
    expect(&mut terminal, "15", "60x24");
    // Pressed at column 11, dragged to column 5, let go: 6 of the 24 that are 180 degrees.
    terminal.press("\x1b[<0;11;3M\x1b[<32;5;3M\x1b[<0;5;3m");
    expect(&mut terminal, "60", "60x24");
    terminal.press("r");
    expect(&mut terminal, "0", "60x24");
    terminal.press("q");
    assert_eq!(terminal.given_back(), (0, String::new()));
}

#[test]
fn the_terminal_is_given_back_by_interruption_signal_and_error() {
    let (_folder, server) = with_dataset();
    let begun = || {
        let mut terminal = Terminal::watch(&server, 60, 13, PLAIN, &[]);
        terminal.wait_for_status(&["final"]);
        terminal
    };
    let mut terminal = begun();
    terminal.press("\x03");
    let (code, said) = terminal.given_back();
    assert!(code == 130 && said.contains("interrupted"), "{code} {said}");

    let terminal = begun();
    terminal.signal("TERM");
    let (code, said) = terminal.given_back();
    assert!(code == 130 && said.contains("interrupted"), "{code} {said}");

    let mut terminal = Terminal::watch(&server, 60, 13, PLAIN, &["--patience", "0"]);
    terminal.wait_for_status(&["final"]);
    server.kill();
    let (code, said) = terminal.given_back();
    assert!(code == 5 && said.contains("error: "), "{code} {said}");
}

#[test]
fn a_server_that_was_away_is_looked_at_again_from_where_the_viewer_is_by_then() {
    let (folder, server) = with_dataset();
    let relay = Relay::before(&server);
    let mut terminal = Terminal::watch(&server, 60, 13, PLAIN, &["--server", &relay.url(&server)]);
    terminal.wait_for_status(&["az 0°", "final"]);
    relay.lead_to(None);
    server.kill();
    terminal.wait_for_status(&["reconnecting"]);
    // Turned meanwhile.
    terminal.press("\x1b[C");
    let server = Server::start(&folder.path().join("data"));
    relay.lead_to(Some(&server));
    terminal.wait_for_status(&["az 5°", "60x24 final"]);
    assert!(terminal.picture().mean(&truth(&server, &folder, "60x24", "5")) < SAME);
    terminal.press("q");
    assert_eq!(terminal.given_back(), (0, String::new()));
}

#[test]
fn a_terminal_that_can_show_pictures_gets_them_in_its_protocol() {
    let (folder, server) = with_dataset();
    let mut terminal = Terminal::watch(&server, 60, 13, WITH_KITTY, &[]);
    // Twelve rows of cells of 10 x 20 pixels, as it said.
    terminal.wait_for_status(&["600x240 final"]);
    let png = of_kitty(&terminal.written).pop().unwrap();
    assert!(Picture::of_png(&png).mean(&truth(&server, &folder, "600x240", "0")) < SAME);
    terminal.press("q");
    assert_eq!(terminal.given_back().0, 0);

    let mut terminal = Terminal::watch(&server, 60, 13, WITH_SIXEL, &[]);
    terminal.wait_for_status(&["480x192 final"]);
    let start = terminal.written.windows(2).rposition(|w| w == b"\x1bP").unwrap();
    let picture = of_sixel(&terminal.written[start..]);
    assert!(picture.mean(&truth(&server, &folder, "480x192", "0")) < PALETTE);
    terminal.press("q");
    assert_eq!(terminal.given_back().0, 0);
}

#[test]
fn a_terminal_that_does_not_answer_gets_half_blocks_and_a_word_of_the_user_stands_above_its_own() {
    let (_folder, server) = with_dataset();
    let mut terminal = Terminal::run(&server, 60, 13, &["watch", DATASET]);
    terminal.wait_for_status(&["60x24 final"]);
    terminal.press("q");
    assert_eq!(terminal.given_back().0, 0);
    let mut terminal = Terminal::watch(&server, 60, 13, WITH_KITTY, &["--protocol", "half-blocks"]);
    // Cells of 10 x 20 pixels: a half block is square.
    terminal.wait_for_status(&["60x24 final"]);
    terminal.press("\x1b");
    assert_eq!(terminal.given_back().0, 0);
}

/// PNGs of the kitty graphics protocol.
fn of_kitty(written: &[u8]) -> Vec<Vec<u8>> {
    let text = String::from_utf8_lossy(written);
    let (mut pictures, mut base64) = (Vec::new(), String::new());
    for command in text.split("\x1b_G").skip(1) {
        let (keys, payload) = command.split_once("\x1b\\").unwrap().0.split_once(';').unwrap_or_default();
        if !keys.starts_with("a=T") && base64.is_empty() {
            continue;
        }
        base64 += payload;
        if keys.ends_with("m=0") {
            pictures.push(base64::engine::general_purpose::STANDARD.decode(std::mem::take(&mut base64)).unwrap());
        }
    }
    pictures
}

/// What a sixel terminal draws: DCS, "q", raster attributes, colours, rows of six.
fn of_sixel(bytes: &[u8]) -> Picture {
    let body = bytes.strip_prefix(b"\x1bP").expect("a device control string");
    let body = &body[body.iter().position(|b| *b == b'q').unwrap() + 1..body.iter().position(|b| *b == 0x1b).unwrap()];
    let mut at = 0;
    let numbers = |at: &mut usize| {
        let end = body[*at..].iter().position(|b| !b.is_ascii_digit() && *b != b';').map_or(body.len(), |n| *at + n);
        let text = std::str::from_utf8(&body[*at..end]).unwrap();
        *at = end;
        text.split(';').filter_map(|n| n.parse().ok()).collect::<Vec<usize>>()
    };
    let (mut width, mut pixels, mut palette) = (0, Vec::new(), vec![[0.0; 3]; 256]);
    let (mut colour, mut column, mut row, mut count) = (0, 0, 0, 1);
    while at < body.len() {
        let byte = body[at];
        at += 1;
        match byte {
            b'"' => {
                let attributes = numbers(&mut at);
                width = attributes[2];
                pixels = vec![[f32::NAN; 3]; width * attributes[3]];
            }
            b'#' => match numbers(&mut at)[..] {
                [name] => colour = name,
                // Space 2: red, green, blue in percent.
                [name, 2, r, g, b] => (colour, palette[name]) = (name, [r, g, b].map(|percent| 2.55 * percent as f32)),
                ref other => panic!("colour {other:?}"),
            },
            b'!' => count = numbers(&mut at)[0],
            b'$' => column = 0,
            b'-' => (column, row) = (0, row + 6),
            b'?'..=b'~' => {
                for bit in (0..6).filter(|bit| (byte - b'?') >> bit & 1 == 1) {
                    pixels[(row + bit) * width + column..][..count].fill(palette[colour]);
                }
                column += count;
                count = 1;
            }
            other => panic!("{other:#x} in sixels"),
        }
    }
    assert!(pixels.iter().flatten().all(|code| !code.is_nan()), "pixels are left out");
    Picture { width, pixels }
}

/// The mean difference that 256 colours make, each rounded to a hundredth (0.6 codes in the mean), the error diffused.
const PALETTE: f32 = 6.0;

/// A picture from an azimuth.
type Printed<'a> = &'a dyn Fn(&str) -> Picture;

#[test]
fn one_picture_is_printed_to_a_pipe_in_every_protocol() {
    let (folder, server) = with_dataset();
    let printed = |protocol: &str, azimuth: &str| {
        let flags = ["--once", "--cells", "60x12", "--protocol", protocol, "--azimuth-deg", azimuth];
        server.succeed(&[&["watch", DATASET], &flags[..]].concat())
    };
    let half_blocks = |azimuth: &str| {
        let text = printed("half-blocks", azimuth);
        let mut emulator = emulator(60, 13);
        emulator.process(text.replace('\n', "\r\n").as_bytes());
        assert_eq!(emulator.screen().cursor_position(), (12, 0));
        let cell = |at: usize, column: u16| emulator.screen().cell(at as u16 / 2, column).unwrap().clone();
        let ground = |at: usize, column: u16| if at.is_multiple_of(2) { cell(at, column).fgcolor() } else { cell(at, column).bgcolor() };
        let pixels = (0..24).flat_map(|row| (0..60).map(move |column| (row, column))).map(|(row, column)| match ground(row, column) {
            Color::Rgb(r, g, b) => [r, g, b].map(f32::from),
            other => panic!("{other:?}"),
        });
        Picture { width: 60, pixels: pixels.collect() }
    };
    let kitty = |azimuth: &str| Picture::of_png(&of_kitty(printed("kitty", azimuth).as_bytes())[0]);
    let sixel = |azimuth: &str| of_sixel(printed("sixel", azimuth).trim_end().as_bytes());
    let cases: [(Printed<'_>, &str, f32); 3] = [(&half_blocks, "60x24", SAME), (&kitty, "480x192", SAME), (&sixel, "480x192", PALETTE)];
    for (picture, size, bound) in cases {
        for azimuth in ["0", "40"] {
            let (other, picture) = (if azimuth == "0" { "40" } else { "0" }, picture(azimuth));
            let difference = picture.mean(&truth(&server, &folder, size, azimuth));
            assert!(difference < bound, "{size} at {azimuth}: {difference}");
            let difference = picture.mean(&truth(&server, &folder, size, other));
            assert!(difference > bound.max(ANOTHER), "{size} at {other} for {azimuth}: {difference}");
        }
    }
}

#[test]
fn without_a_terminal_the_error_says_what_to_use_instead() {
    let (_folder, server) = with_dataset();
    for (flags, word) in [(&[][..], "lumisphere stream"), (&["--once"], "--protocol"), (&["--protocol", "sixel"], "lumisphere stream")] {
        let output = server.lumisphere(&[&["watch", DATASET], flags].concat());
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!((output.status.code(), output.stdout.is_empty()), (Some(2), true), "{said}");
        assert!(said.contains(word), "{said}");
    }
    let code = |arguments: &[&str]| server.lumisphere(arguments).status.code();
    let once = ["--once", "--protocol", "half-blocks"];
    assert_eq!(code(&[&["watch", "nothing"], &once[..]].concat()), Some(3));
    assert_eq!(code(&[&["watch", DATASET, "--fov-deg", "NaN"], &once[..]].concat()), Some(2));
    // Of the other kind of datasets: the server's no, in the stream.
    assert_eq!(code(&[&["watch", DATASET, "--component", "radiance"], &once[..]].concat()), Some(7));
}
