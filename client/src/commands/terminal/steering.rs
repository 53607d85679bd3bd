//! Keys and mouse as changes of the viewpoint: a state machine without a terminal. The viewpoint is an orbit around a target with the angles
//! of the command line's orbit, and moves as the browser's does (`client/web/src/camera.ts`, `controls.ts`).

use crossterm::event::{Event, KeyCode, KeyEvent, KeyEventKind, KeyModifiers, MouseButton, MouseEvent, MouseEventKind};
use glam::Vec3;
use lumisphere_proto::v1alpha1 as wire;

use super::pictures::FrameSize;
use crate::cameras::{rigid, vec3};

/// Of one press of an arrow key.
const TURN_DEG: f32 = 5.0;
/// Of one press of + or a notch of the wheel.
const CLOSER: f32 = 0.9;
/// Of one press of W, A, S or D, in radii of the object.
const STEP_RADII: f32 = 0.1;
/// A drag across the shorter side.
const DRAG_DEG: f32 = 180.0;
/// Distances to the target, in radii, as in the browser.
const DISTANCE_RADII: (f32, f32) = (0.02, 200.0);

/// Where the viewer is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Viewpoint {
    /// What the orbit turns around.
    pub target: Vec3,
    /// From the target to the eye, scene units.
    pub distance: f32,
    /// From +Z toward +X.
    pub azimuth_deg: f32,
    /// Above the horizon, −90 to 90.
    pub elevation_deg: f32,
    /// Across the shorter side of the picture.
    pub field_of_view_deg: f32,
}

/// What an event asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reaction {
    /// Nothing that is seen.
    Nothing,
    /// The viewpoint is another one.
    Moved,
    /// The terminal has another size.
    Resized,
    /// Done.
    Quit,
    /// Ctrl-C, which is a key while the terminal is raw.
    Interrupted,
}

/// A viewpoint under way.
#[derive(Debug, Clone)]
pub struct Steering {
    view: Viewpoint,
    home: Viewpoint,
    /// Of the object, scene units: the measure of steps.
    radius: f32,
    /// Where a drag was last, cells.
    dragged: Option<(u16, u16)>,
}

impl Viewpoint {
    /// Around the box's centre.
    pub fn around(bounds: &wire::Box3, azimuth_deg: f32, elevation_deg: f32, distance_radii: f32, field_of_view_deg: f32) -> Self {
        let (min, max) = corners(bounds);
        let (target, distance) = (0.5 * (min + max), distance_radii * radius(bounds));
        Self { target, distance, azimuth_deg, elevation_deg, field_of_view_deg }
    }

    /// Right, up, backward; at the poles, too, where a look-at has none.
    fn axes(&self) -> [Vec3; 3] {
        let (sin_azimuth, cos_azimuth) = self.azimuth_deg.to_radians().sin_cos();
        let (sin, cos) = self.elevation_deg.to_radians().sin_cos();
        let backward = Vec3::new(cos * sin_azimuth, sin, cos * cos_azimuth);
        let right = Vec3::new(cos_azimuth, 0.0, -sin_azimuth);
        [right, backward.cross(right), backward]
    }

    /// The wire's camera for a picture of this size.
    pub fn camera(&self, size: FrameSize) -> wire::Camera {
        let axes = self.axes();
        let (width, height) = (size.width_px as f32 * size.pixel_aspect, size.height_px as f32);
        // In heights of a pixel.
        let focal = 0.5 * width.min(height) / (0.5 * self.field_of_view_deg.to_radians()).tan();
        let intrinsics = wire::Intrinsics {
            width_px: size.width_px,
            height_px: size.height_px,
            focal_x_px: focal / size.pixel_aspect,
            focal_y_px: focal,
            center_x_px: None,
            center_y_px: None,
        };
        wire::Camera { pose: Some(rigid(self.target + self.distance * axes[2], axes)), intrinsics: Some(intrinsics) }
    }

    fn turn(&mut self, azimuth_deg: f32, elevation_deg: f32) {
        self.azimuth_deg = (self.azimuth_deg + azimuth_deg).rem_euclid(360.0);
        self.elevation_deg = (self.elevation_deg + elevation_deg).clamp(-90.0, 90.0);
    }

    /// Along the camera's own axes, scene units.
    fn fly(&mut self, right: f32, forward: f32) {
        let axes = self.axes();
        self.target += right * axes[0] - forward * axes[2];
    }
}

/// Half the diagonal.
pub fn radius(bounds: &wire::Box3) -> f32 {
    let (min, max) = corners(bounds);
    0.5 * (max - min).length()
}

fn corners(bounds: &wire::Box3) -> (Vec3, Vec3) {
    (vec3(bounds.min.unwrap_or_default()), vec3(bounds.max.unwrap_or_default()))
}

impl Steering {
    /// At home.
    pub fn new(home: Viewpoint, radius: f32) -> Self {
        Self { view: home, home, radius, dragged: None }
    }

    /// Where the viewer is now.
    pub fn view(&self) -> &Viewpoint {
        &self.view
    }

    /// Takes one event. `size`: of the picture; `cell_px`: of a cell in the same pixels.
    pub fn take(&mut self, event: &Event, size: FrameSize, cell_px: (f32, f32)) -> Reaction {
        let before = self.view;
        match event {
            Event::Resize(..) => return Reaction::Resized,
            Event::Key(key) if key.kind != KeyEventKind::Release => {
                if let Some(end) = self.press(key) {
                    return end;
                }
            }
            Event::Mouse(mouse) => self.point(mouse, size, cell_px),
            _ => {}
        }
        if self.view == before { Reaction::Nothing } else { Reaction::Moved }
    }

    /// The end, if that is what the key says.
    fn press(&mut self, key: &KeyEvent) -> Option<Reaction> {
        let step = STEP_RADII * self.radius;
        match key.code {
            KeyCode::Char('c' | 'C') if key.modifiers.contains(KeyModifiers::CONTROL) => return Some(Reaction::Interrupted),
            // Other keys with Ctrl or Alt are not ours.
            _ if key.modifiers.intersects(KeyModifiers::CONTROL | KeyModifiers::ALT) => {}
            KeyCode::Char('q' | 'Q') | KeyCode::Esc => return Some(Reaction::Quit),
            KeyCode::Char('r' | 'R') | KeyCode::Home => self.view = self.home,
            KeyCode::Left => self.view.turn(-TURN_DEG, 0.0),
            KeyCode::Right => self.view.turn(TURN_DEG, 0.0),
            KeyCode::Up => self.view.turn(0.0, TURN_DEG),
            KeyCode::Down => self.view.turn(0.0, -TURN_DEG),
            KeyCode::Char('a' | 'A') => self.view.fly(-step, 0.0),
            KeyCode::Char('d' | 'D') => self.view.fly(step, 0.0),
            KeyCode::Char('w' | 'W') => self.view.fly(0.0, step),
            KeyCode::Char('s' | 'S') => self.view.fly(0.0, -step),
            KeyCode::Char('+' | '=') | KeyCode::PageUp => self.dolly(CLOSER),
            KeyCode::Char('-' | '_') | KeyCode::PageDown => self.dolly(1.0 / CLOSER),
            _ => {}
        }
        None
    }

    /// What is dragged follows the pointer.
    fn point(&mut self, mouse: &MouseEvent, size: FrameSize, (cell_width, cell_height): (f32, f32)) {
        let here = (mouse.column, mouse.row);
        match mouse.kind {
            MouseEventKind::Down(MouseButton::Left) => self.dragged = Some(here),
            MouseEventKind::Up(MouseButton::Left) => self.dragged = None,
            MouseEventKind::Drag(MouseButton::Left) => {
                let there = self.dragged.replace(here).unwrap_or(here);
                let right = (f32::from(here.0) - f32::from(there.0)) * cell_width * size.pixel_aspect;
                let down = (f32::from(here.1) - f32::from(there.1)) * cell_height;
                let side = (size.width_px as f32 * size.pixel_aspect).min(size.height_px as f32);
                self.view.turn(-DRAG_DEG * right / side, DRAG_DEG * down / side);
            }
            MouseEventKind::ScrollUp => self.dolly(CLOSER),
            MouseEventKind::ScrollDown => self.dolly(1.0 / CLOSER),
            _ => {}
        }
    }

    fn dolly(&mut self, factor: f32) {
        let (least, most) = DISTANCE_RADII;
        self.view.distance = (self.view.distance * factor).clamp(least * self.radius, most * self.radius);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: FrameSize = FrameSize { width_px: 160, height_px: 80, pixel_aspect: 1.0 };
    /// Of half blocks.
    const CELL_PX: (f32, f32) = (1.0, 2.0);

    fn bounds() -> wire::Box3 {
        let corner = |s: f32| Some(wire::Vector3 { x: s, y: s + 1.0, z: s });
        wire::Box3 { min: corner(-1.0), max: corner(1.0) }
    }

    fn steering() -> Steering {
        Steering::new(Viewpoint::around(&bounds(), 0.0, 0.0, 2.0, 40.0), radius(&bounds()))
    }

    fn key(code: KeyCode) -> Event {
        Event::Key(KeyEvent::new(code, KeyModifiers::NONE))
    }

    fn after(keys: &[KeyCode]) -> Viewpoint {
        let mut steering = steering();
        for code in keys {
            assert_eq!(steering.take(&key(*code), SIZE, CELL_PX), Reaction::Moved, "{code:?}");
        }
        *steering.view()
    }

    fn mouse(kind: MouseEventKind, column: u16, row: u16) -> Event {
        Event::Mouse(MouseEvent { kind, column, row, modifiers: KeyModifiers::NONE })
    }

    #[test]
    fn arrows_turn_about_the_object_and_stop_at_the_poles() {
        let home = after(&[]);
        assert_eq!((after(&[KeyCode::Right]).azimuth_deg, after(&[KeyCode::Left]).azimuth_deg), (5.0, 355.0));
        assert_eq!((after(&[KeyCode::Up]).elevation_deg, after(&[KeyCode::Down]).elevation_deg), (5.0, -5.0));
        assert_eq!((after(&[KeyCode::Up]).target, after(&[KeyCode::Up]).distance), (home.target, home.distance));
        assert_eq!(after(&[KeyCode::Up; 18]).elevation_deg, 90.0);
        let mut there = steering();
        (0..18).for_each(|_| assert_eq!(there.take(&key(KeyCode::Up), SIZE, CELL_PX), Reaction::Moved));
        assert_eq!(there.take(&key(KeyCode::Up), SIZE, CELL_PX), Reaction::Nothing);
    }

    #[test]
    fn letters_fly_along_the_cameras_axes_and_signs_change_the_distance() {
        let radius = 3f32.sqrt();
        // From +Z the camera looks along −Z, its right is +X.
        let moved = |code: char| after(&[KeyCode::Char(code)]).target - after(&[]).target;
        for (code, along) in [('w', -Vec3::Z), ('s', Vec3::Z), ('a', -Vec3::X), ('D', Vec3::X)] {
            assert!((moved(code) - 0.1 * radius * along).length() < 1e-6, "{code}: {}", moved(code));
        }
        let distance = |code| after(&[code]).distance / after(&[]).distance;
        for (code, factor) in
            [(KeyCode::Char('+'), 0.9), (KeyCode::Char('='), 0.9), (KeyCode::Char('-'), 1.0 / 0.9), (KeyCode::PageUp, 0.9)]
        {
            assert!((distance(code) - factor).abs() < 1e-6, "{code:?}");
        }
        assert_eq!(after(&[KeyCode::Char('w'), KeyCode::Up, KeyCode::Char('-'), KeyCode::Char('r')]), after(&[]));
    }

    #[test]
    fn the_distance_has_bounds() {
        let mut steering = steering();
        let times = (0..200).take_while(|_| steering.take(&key(KeyCode::Char('+')), SIZE, CELL_PX) == Reaction::Moved).count();
        // 2 · 0.9ⁿ reaches 0.02 radii.
        assert_eq!(times, 44);
        assert!((steering.view().distance - 0.02 * 3f32.sqrt()).abs() < 1e-6);
        assert_eq!(steering.take(&key(KeyCode::Char('+')), SIZE, CELL_PX), Reaction::Nothing);
    }

    #[test]
    fn q_escape_and_ctrl_c_end_and_a_key_let_go_or_another_does_nothing() {
        let reaction = |code, modifiers| steering().take(&Event::Key(KeyEvent::new(code, modifiers)), SIZE, CELL_PX);
        assert_eq!(reaction(KeyCode::Char('q'), KeyModifiers::NONE), Reaction::Quit);
        assert_eq!(reaction(KeyCode::Esc, KeyModifiers::NONE), Reaction::Quit);
        assert_eq!(reaction(KeyCode::Char('c'), KeyModifiers::CONTROL), Reaction::Interrupted);
        for (code, modifiers) in
            [(KeyCode::Char('c'), KeyModifiers::NONE), (KeyCode::Char('w'), KeyModifiers::CONTROL), (KeyCode::Tab, KeyModifiers::NONE)]
        {
            assert_eq!(reaction(code, modifiers), Reaction::Nothing, "{code:?}");
        }
        let let_go = KeyEvent { kind: KeyEventKind::Release, ..KeyEvent::new(KeyCode::Char('q'), KeyModifiers::NONE) };
        assert_eq!(steering().take(&Event::Key(let_go), SIZE, CELL_PX), Reaction::Nothing);
        assert_eq!(steering().take(&Event::Resize(9, 9), SIZE, CELL_PX), Reaction::Resized);
    }

    #[test]
    fn a_drag_carries_the_object_along_and_the_wheel_comes_closer() {
        let mut steering = steering();
        let mut take = |kind, column, row| {
            let reaction = steering.take(&mouse(kind, column, row), SIZE, CELL_PX);
            (reaction, *steering.view())
        };
        let left = MouseButton::Left;
        assert_eq!(take(MouseEventKind::Down(left), 10, 10).0, Reaction::Nothing);
        // The shorter side is 80 px: 20 columns of one are a quarter of it, 10 rows of two, too.
        let (reaction, view) = take(MouseEventKind::Drag(left), 30, 20);
        assert_eq!((reaction, view.azimuth_deg, view.elevation_deg), (Reaction::Moved, 315.0, 45.0));
        take(MouseEventKind::Up(left), 30, 20);
        // A new drag begins where it begins.
        take(MouseEventKind::Down(left), 50, 5);
        assert_eq!(take(MouseEventKind::Drag(left), 50, 5), (Reaction::Nothing, view));
        assert!(take(MouseEventKind::ScrollUp, 0, 0).1.distance < view.distance);
    }

    #[test]
    fn the_camera_is_rigid_everywhere_and_sees_the_same_through_pixels_of_any_shape() {
        for elevation_deg in [-90.0, -30.0, 0.0, 90.0] {
            let view = Viewpoint { elevation_deg, azimuth_deg: 70.0, ..after(&[]) };
            let axes = view.axes();
            assert!((axes[0].cross(axes[1]) - axes[2]).length() < 1e-6 && axes.iter().all(|a| (a.length() - 1.0).abs() < 1e-6));
        }
        let focal = |size| {
            let intrinsics = after(&[]).camera(size).intrinsics.unwrap();
            (intrinsics.focal_x_px / intrinsics.width_px as f32, intrinsics.focal_y_px / intrinsics.height_px as f32)
        };
        // Twice as wide pixels, half as many.
        let (square, wide) = (focal(SIZE), focal(FrameSize { width_px: 80, pixel_aspect: 2.0, ..SIZE }));
        assert!((square.0 - wide.0).abs() < 1e-6 && (square.1 - wide.1).abs() < 1e-6, "{square:?} {wide:?}");
        // 40° across the height: tan 20° is half of it.
        assert!((square.1 - 0.5 / 20f32.to_radians().tan()).abs() < 1e-5);
    }
}
