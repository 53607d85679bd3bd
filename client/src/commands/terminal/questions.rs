//! What the terminal can do, by asking it. Every terminal answers the last question (its primary device attributes), so that one that does
//! not know the others is not waited for.
//!
//! Sources: kitty graphics protocol, "Querying support"; DEC VT3xx, "DA1" (attribute 4: sixel); xterm, "XTWINOPS" (16: a cell's size).

use std::io;
use std::time::Duration;

/// Over a slow line, on a busy machine; a terminal on an idle one answers within a millisecond.
const PATIENCE: Duration = Duration::from_secs(5);
/// An image of one pixel, to be checked and not shown, named 31; the size of a cell; the device's attributes.
#[cfg_attr(not(unix), allow(dead_code))]
const QUESTIONS: &[u8] = b"\x1b_Gi=31,s=1,v=1,a=q,t=d,f=24;AAAA\x1b\\\x1b[16t\x1b[c";
/// Longer answers are none.
#[cfg_attr(not(unix), allow(dead_code))]
const MOST_BYTES: usize = 4096;

/// What it said.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Answers {
    /// It takes the kitty graphics protocol.
    pub kitty: bool,
    /// It takes sixel.
    pub sixel: bool,
    /// Width and height of a cell.
    pub cell_px: Option<(u32, u32)>,
    /// The last question is answered.
    pub is_complete: bool,
}

/// Asks. The terminal must be raw, and nobody else may read its input meanwhile. One that says nothing can do nothing.
#[cfg(unix)]
pub fn ask() -> io::Result<Answers> {
    use std::io::{IsTerminal, Write};
    use std::os::fd::{AsFd, OwnedFd};
    use std::time::Instant;

    use rustix::event::{PollFd, PollFlags, Timespec, poll};

    let input: OwnedFd = match io::stdin() {
        stdin if stdin.is_terminal() => stdin.as_fd().try_clone_to_owned()?,
        _ => std::fs::File::open("/dev/tty")?.into(),
    };
    let mut out = io::stdout().lock();
    out.write_all(QUESTIONS)?;
    out.flush()?;
    let until = Instant::now() + PATIENCE;
    let mut said = Vec::new();
    loop {
        let left = until.saturating_duration_since(Instant::now());
        let left = Timespec { tv_sec: left.as_secs() as i64, tv_nsec: i64::from(left.subsec_nanos()) };
        let is_ready = match poll(&mut [PollFd::new(&input, PollFlags::IN)], Some(&left)) {
            Err(rustix::io::Errno::INTR) => continue,
            ready => ready? > 0,
        };
        let mut bytes = [0; 256];
        let count = if is_ready { rustix::io::read(&input, &mut bytes)? } else { 0 };
        said.extend_from_slice(&bytes[..count]);
        let answers = understood(&said);
        if count == 0 || answers.is_complete || said.len() > MOST_BYTES {
            return Ok(answers);
        }
    }
}

/// Elsewhere nothing is asked.
#[cfg(not(unix))]
pub fn ask() -> io::Result<Answers> {
    let _ = PATIENCE;
    Ok(Answers::default())
}

/// What was said so far; keys that were pressed meanwhile are passed over.
fn understood(said: &[u8]) -> Answers {
    let mut answers = Answers::default();
    let text = String::from_utf8_lossy(said);
    for part in text.split('\x1b').skip(1) {
        if let Some(graphics) = part.strip_prefix("_G") {
            answers.kitty |= graphics.split_once(';').is_some_and(|(keys, word)| keys.split(',').any(|k| k == "i=31") && word == "OK");
        } else if let Some((attributes, _)) = part.strip_prefix("[?").and_then(|p| p.split_once('c')) {
            answers.sixel |= attributes.split(';').any(|a| a == "4");
            answers.is_complete = true;
        } else if let Some((size, _)) = part.strip_prefix("[6;").and_then(|p| p.split_once('t')) {
            let size = size.split_once(';').and_then(|(height, width)| Some((width.parse().ok()?, height.parse().ok()?)));
            answers.cell_px = size.filter(|&(width, height): &(u32, u32)| sane(width) && sane(height));
        }
    }
    answers
}

/// No font is smaller or larger.
pub fn sane(side_px: u32) -> bool {
    (1..=256).contains(&side_px)
}

#[cfg(test)]
mod tests {
    use super::*;

    const KITTY: &[u8] = b"\x1b_Gi=31;OK\x1b\\\x1b[6;20;10t\x1b[?62;c";

    #[test]
    fn answers_say_what_the_terminal_can_do() {
        let complete = Answers { is_complete: true, ..Answers::default() };
        assert_eq!(understood(KITTY), Answers { kitty: true, cell_px: Some((10, 20)), ..complete });
        assert_eq!(understood(b"\x1b[?62;4;22c"), Answers { sixel: true, ..complete });
        // Attributes 14 and 42 are others.
        assert_eq!(understood(b"\x1b[?64;14;42c"), complete);
        assert_eq!(understood(b"\x1b_Gi=31;EINVAL:no\x1b\\\x1b[?1;2c"), complete);
        assert_eq!(understood(b"\x1b_Gi=3;OK\x1b\\\x1b[?1;2c"), complete);
    }

    #[test]
    fn half_an_answer_is_not_the_end_and_keys_between_do_no_harm() {
        for end in 0..KITTY.len() {
            assert!(!understood(&KITTY[..end]).is_complete, "{end}");
        }
        let keys = b"q\x1b[A\x1b[?62;4c";
        assert_eq!(understood(keys), Answers { sixel: true, is_complete: true, ..Answers::default() });
        assert_eq!(understood(b"\x1b[6;0;99999t\xff\x1b[?c"), Answers { is_complete: true, ..Answers::default() });
    }
}
