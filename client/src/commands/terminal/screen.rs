//! The terminal while it is ours, and as it was before: on every way out (a key, a signal, an error, a panic) it is given back.

use std::io::{self, Write};
use std::sync::Once;
use std::sync::atomic::{AtomicBool, Ordering};

use crossterm::event::{DisableMouseCapture, EnableMouseCapture};
use crossterm::style::ResetColor;
use crossterm::terminal::{Clear, ClearType, EnterAlternateScreen, LeaveAlternateScreen, disable_raw_mode, enable_raw_mode};
use crossterm::{cursor, execute, queue};

use super::pictures::KITTY_CLEAR;

/// Is ours, so that it is given back once.
static IS_OURS: AtomicBool = AtomicBool::new(false);
/// Pictures are on it that stay when the screen is left.
static HAS_PICTURES: AtomicBool = AtomicBool::new(false);

/// Raw, on the other screen, without cursor, with mouse; dropped, it is as before.
pub struct Screen(());

impl Screen {
    /// Takes the terminal.
    pub fn take() -> io::Result<Self> {
        tell_panics_on_the_old_screen();
        enable_raw_mode()?;
        IS_OURS.store(true, Ordering::SeqCst);
        // From here on a failure gives it back.
        let screen = Self(());
        execute!(io::stdout(), EnterAlternateScreen, cursor::Hide, EnableMouseCapture, Clear(ClearType::All))?;
        Ok(screen)
    }

    /// Pictures will be placed with the kitty graphics protocol.
    pub fn has_pictures(&self) {
        HAS_PICTURES.store(true, Ordering::SeqCst);
    }

    /// Empties the screen.
    pub fn clear(&self) -> io::Result<()> {
        let mut out = io::stdout().lock();
        if HAS_PICTURES.load(Ordering::SeqCst) {
            out.write_all(KITTY_CLEAR)?;
        }
        execute!(out, Clear(ClearType::All))
    }

    /// All at once where the terminal can (synchronized output).
    pub fn show(&self, picture: &[u8], status: &str, status_row: u16) -> io::Result<()> {
        let mut out = io::stdout().lock();
        queue!(out, crossterm::terminal::BeginSynchronizedUpdate, cursor::MoveTo(0, 0))?;
        out.write_all(picture)?;
        queue!(out, cursor::MoveTo(0, status_row), ResetColor, Clear(ClearType::CurrentLine))?;
        out.write_all(status.as_bytes())?;
        queue!(out, crossterm::terminal::EndSynchronizedUpdate)?;
        out.flush()
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        give_back();
    }
}

/// What fails here cannot be helped: the terminal may have gone.
fn give_back() {
    if !IS_OURS.swap(false, Ordering::SeqCst) {
        return;
    }
    let mut out = io::stdout().lock();
    if HAS_PICTURES.load(Ordering::SeqCst) {
        let _ = out.write_all(KITTY_CLEAR);
    }
    let _ = execute!(out, crossterm::terminal::EndSynchronizedUpdate, ResetColor, DisableMouseCapture, cursor::Show, LeaveAlternateScreen);
    let _ = disable_raw_mode();
}

/// A panic's message is not lost with the other screen.
fn tell_panics_on_the_old_screen() {
    static HOOK: Once = Once::new();
    HOOK.call_once(|| {
        let before = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            give_back();
            before(panic);
        }));
    });
}

/// Raw for as long as a question takes.
pub struct Raw(());

impl Raw {
    /// Keys and answers come at once and are not echoed.
    pub fn take() -> io::Result<Self> {
        enable_raw_mode().map(|()| Self(()))
    }
}

impl Drop for Raw {
    fn drop(&mut self) {
        let _ = disable_raw_mode();
    }
}
