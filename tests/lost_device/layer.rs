//! A Vulkan layer that loses the device: while the file that `LOST_DEVICE` names is there, whatever is submitted to a queue answers
//! `VK_ERROR_DEVICE_LOST`, as a driver does whose adapter hangs or is taken away. Everything else goes to the driver below.
//!
//! Built as a library that Vulkan's loader opens (the loader's layer interface, version 2: Khronos, `LoaderLayerInterface.md`), for processes
//! whose devices are all one driver's.

// The loader's interface is C's.
#![allow(unsafe_code)]

use std::ffi::{CStr, c_char, c_void};
use std::path::Path;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};

use ash::vk::{self, Handle};

/// The loader's `VkNegotiateLayerInterface`.
#[repr(C)]
pub struct NegotiateLayerInterface {
    structure: u32,
    next: *const c_void,
    version: u32,
    get_instance_proc_addr: Option<vk::PFN_vkGetInstanceProcAddr>,
    get_device_proc_addr: Option<vk::PFN_vkGetDeviceProcAddr>,
    get_physical_device_proc_addr: *const c_void,
}

/// `VkLayerInstanceCreateInfo` and `VkLayerDeviceCreateInfo`, of which each layer takes a link.
#[repr(C)]
struct LayerCreateInfo {
    structure: vk::StructureType,
    next: *mut Self,
    function: u32,
    link: *mut LayerLink,
}

/// `VkLayerInstanceLink` and `VkLayerDeviceLink`: the layer below.
#[repr(C)]
struct LayerLink {
    next: *mut Self,
    get_instance_proc_addr: vk::PFN_vkGetInstanceProcAddr,
    /// Of an instance it is another function, which is not called.
    get_device_proc_addr: vk::PFN_vkGetDeviceProcAddr,
}

/// `VK_LAYER_LINK_INFO`
const LINK_INFO: u32 = 0;

/// The latest.
static INSTANCE: AtomicU64 = AtomicU64::new(0);
static INSTANCE_BELOW: OnceLock<vk::PFN_vkGetInstanceProcAddr> = OnceLock::new();
static DEVICE_BELOW: OnceLock<vk::PFN_vkGetDeviceProcAddr> = OnceLock::new();
static SUBMIT_BELOW: OnceLock<vk::PFN_vkQueueSubmit> = OnceLock::new();

/// What the loader calls first.
///
/// # Safety
/// As the loader calls it.
#[unsafe(no_mangle)]
pub unsafe extern "system" fn vkNegotiateLoaderLayerInterfaceVersion(layer: *mut NegotiateLayerInterface) -> vk::Result {
    let layer = unsafe { &mut *layer };
    layer.version = layer.version.min(2);
    layer.get_instance_proc_addr = Some(instance_function);
    layer.get_device_proc_addr = Some(device_function);
    layer.get_physical_device_proc_addr = std::ptr::null();
    vk::Result::SUCCESS
}

macro_rules! function {
    ($kind:ty, $ours:path) => {
        unsafe { std::mem::transmute::<$kind, vk::PFN_vkVoidFunction>($ours) }
    };
}

unsafe extern "system" fn instance_function(instance: vk::Instance, name: *const c_char) -> vk::PFN_vkVoidFunction {
    match unsafe { CStr::from_ptr(name) }.to_bytes() {
        b"vkGetInstanceProcAddr" => function!(vk::PFN_vkGetInstanceProcAddr, instance_function),
        b"vkGetDeviceProcAddr" => function!(vk::PFN_vkGetDeviceProcAddr, device_function),
        b"vkCreateInstance" => function!(vk::PFN_vkCreateInstance, create_instance),
        b"vkCreateDevice" => function!(vk::PFN_vkCreateDevice, create_device),
        _ => INSTANCE_BELOW.get().and_then(|below| unsafe { below(instance, name) }),
    }
}

unsafe extern "system" fn device_function(device: vk::Device, name: *const c_char) -> vk::PFN_vkVoidFunction {
    match unsafe { CStr::from_ptr(name) }.to_bytes() {
        b"vkGetDeviceProcAddr" => function!(vk::PFN_vkGetDeviceProcAddr, device_function),
        b"vkQueueSubmit" => function!(vk::PFN_vkQueueSubmit, queue_submit),
        _ => DEVICE_BELOW.get().and_then(|below| unsafe { below(device, name) }),
    }
}

/// The link to the layer below, taken from what a creation is given.
unsafe fn below(creation: *const c_void, structure: vk::StructureType) -> Option<&'static LayerLink> {
    let mut info = creation as *mut LayerCreateInfo;
    while let Some(found) = unsafe { info.as_mut() } {
        if found.structure == structure && found.function == LINK_INFO {
            let link = unsafe { found.link.as_ref() }?;
            found.link = link.next;
            return Some(link);
        }
        info = found.next;
    }
    None
}

unsafe extern "system" fn create_instance(
    creation: *const vk::InstanceCreateInfo<'_>,
    allocator: *const vk::AllocationCallbacks<'_>,
    instance: *mut vk::Instance,
) -> vk::Result {
    let Some(link) = (unsafe { below((*creation).p_next, vk::StructureType::LOADER_INSTANCE_CREATE_INFO) }) else {
        return vk::Result::ERROR_INITIALIZATION_FAILED;
    };
    let next = *INSTANCE_BELOW.get_or_init(|| link.get_instance_proc_addr);
    match unsafe { next(vk::Instance::null(), c"vkCreateInstance".as_ptr()) } {
        Some(create) => {
            let create = unsafe { std::mem::transmute::<unsafe extern "system" fn(), vk::PFN_vkCreateInstance>(create) };
            let created = unsafe { create(creation, allocator, instance) };
            INSTANCE.store(unsafe { *instance }.as_raw(), Ordering::SeqCst);
            created
        }
        None => vk::Result::ERROR_INITIALIZATION_FAILED,
    }
}

unsafe extern "system" fn create_device(
    adapter: vk::PhysicalDevice,
    creation: *const vk::DeviceCreateInfo<'_>,
    allocator: *const vk::AllocationCallbacks<'_>,
    device: *mut vk::Device,
) -> vk::Result {
    let Some(link) = (unsafe { below((*creation).p_next, vk::StructureType::LOADER_DEVICE_CREATE_INFO) }) else {
        return vk::Result::ERROR_INITIALIZATION_FAILED;
    };
    let next = *DEVICE_BELOW.get_or_init(|| link.get_device_proc_addr);
    let instance = vk::Instance::from_raw(INSTANCE.load(Ordering::SeqCst));
    let Some(create) = (unsafe { (link.get_instance_proc_addr)(instance, c"vkCreateDevice".as_ptr()) }) else {
        return vk::Result::ERROR_INITIALIZATION_FAILED;
    };
    let create = unsafe { std::mem::transmute::<unsafe extern "system" fn(), vk::PFN_vkCreateDevice>(create) };
    let created = unsafe { create(adapter, creation, allocator, device) };
    if created == vk::Result::SUCCESS
        && let Some(submit) = unsafe { next(*device, c"vkQueueSubmit".as_ptr()) }
    {
        SUBMIT_BELOW.get_or_init(|| unsafe { std::mem::transmute::<unsafe extern "system" fn(), vk::PFN_vkQueueSubmit>(submit) });
    }
    created
}

unsafe extern "system" fn queue_submit(queue: vk::Queue, count: u32, batches: *const vk::SubmitInfo<'_>, fence: vk::Fence) -> vk::Result {
    let is_lost = std::env::var_os("LOST_DEVICE").is_some_and(|file| Path::new(&file).exists());
    match SUBMIT_BELOW.get() {
        Some(submit) if !is_lost => unsafe { submit(queue, count, batches, fence) },
        _ => vk::Result::ERROR_DEVICE_LOST,
    }
}
