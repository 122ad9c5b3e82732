// A second device in the CPU's memory, for tests without a GPU: torch's operations run on the CPU, and those that are
// given tensors of both devices are refused as on a GPU.
#include <ATen/ATen.h>
#include <ATen/CPUGeneratorImpl.h>
#include <ATen/core/GeneratorForPrivateuseone.h>
#include <ATen/detail/PrivateUse1HooksInterface.h>
#include <ATen/native/Resize.h>
#include <ATen/ops/view_native.h>
#include <ATen/ops/as_strided_native.h>
#include <ATen/ops/_reshape_alias_native.h>
#include <ATen/EmptyTensor.h>
#include <c10/core/impl/DeviceGuardImplInterface.h>
#include <c10/core/impl/alloc_cpu.h>
#include <torch/library.h>

#include <set>

namespace {

constexpr auto SECOND = c10::DeviceType::PrivateUse1;
using Stack = torch::jit::Stack;

struct Memory final : at::Allocator {
  at::DataPtr allocate(size_t bytes) override {
    void* data = bytes ? c10::alloc_cpu(bytes) : nullptr;
    return {data, data, &c10::free_cpu, c10::Device(SECOND, 0)};
  }
  at::DeleterFnPtr raw_deleter() const override { return &c10::free_cpu; }
  void copy_data(void* to, const void* from, size_t bytes) const override { std::memcpy(to, from, bytes); }
};
Memory memory;
REGISTER_ALLOCATOR(SECOND, &memory);

// One device with one stream, which is done at once.
struct Guard final : c10::impl::DeviceGuardImplInterface {
  c10::DeviceType type() const override { return SECOND; }
  c10::Device exchangeDevice(c10::Device) const override { return {SECOND, 0}; }
  c10::Device getDevice() const override { return {SECOND, 0}; }
  void setDevice(c10::Device) const override {}
  void uncheckedSetDevice(c10::Device) const noexcept override {}
  c10::Stream getStream(c10::Device) const override { return c10::Stream(c10::Stream::DEFAULT, c10::Device(SECOND, 0)); }
  c10::Stream getDefaultStream(c10::Device) const override { return c10::Stream(c10::Stream::DEFAULT, c10::Device(SECOND, 0)); }
  c10::Stream getNewStream(c10::Device, int) const override { return c10::Stream(c10::Stream::DEFAULT, c10::Device(SECOND, 0)); }
  c10::Stream exchangeStream(c10::Stream stream) const override { return stream; }
  c10::DeviceIndex deviceCount() const noexcept override { return 1; }
  void record(void**, const c10::Stream&, const c10::DeviceIndex, const c10::EventFlag) const override {}
  void block(void*, const c10::Stream&) const override {}
  bool queryEvent(void*) const override { return true; }
  void destroyEvent(void*, const c10::DeviceIndex) const noexcept override {}
  bool queryStream(const c10::Stream&) const override { return true; }
  void synchronizeStream(const c10::Stream&) const override {}
  void synchronizeEvent(void*) const override {}
  void synchronizeDevice(const c10::DeviceIndex) const override {}
};
C10_REGISTER_GUARD_IMPL(PrivateUse1, Guard);

// Draws what the CPU's generator of the same seed draws.
struct Draws final : c10::GeneratorImpl {
  at::Generator cpu;
  explicit Draws(at::Generator of)
      : c10::GeneratorImpl(c10::Device(SECOND, 0), c10::DispatchKeySet(c10::DispatchKey::PrivateUse1)), cpu(std::move(of)) {}
  void set_current_seed(uint64_t seed) override { cpu.set_current_seed(seed); }
  void set_offset(uint64_t offset) override { cpu.set_offset(offset); }
  uint64_t get_offset() const override { return cpu.get_offset(); }
  uint64_t current_seed() const override { return cpu.current_seed(); }
  uint64_t seed() override { return cpu.seed(); }
  void set_state(const c10::TensorImpl& state) override {
    cpu.set_state(at::Tensor(c10::intrusive_ptr<c10::TensorImpl>::reclaim_copy(const_cast<c10::TensorImpl*>(&state))));
  }
  c10::intrusive_ptr<c10::TensorImpl> get_state() const override { return cpu.get_state().getIntrusivePtr(); }
  Draws* clone_impl() const override { return new Draws(cpu.clone()); }
  static c10::DeviceType device_type() { return SECOND; }
};

struct Hooks final : at::PrivateUse1HooksInterface {
  at::Generator draws = at::make_generator<Draws>(at::detail::createCPUGenerator(0));
  const at::Generator& getDefaultGenerator(c10::DeviceIndex) const override { return draws; }
  at::Generator getNewGenerator(c10::DeviceIndex) const override {
    return at::make_generator<Draws>(at::detail::createCPUGenerator());
  }
  at::Device getDeviceFromPtr(void*) const override { return {SECOND, 0}; }
  bool isPinnedPtr(const void*) const override { return false; }
  bool hasPrimaryContext(c10::DeviceIndex) const override { return true; }
  bool isBuilt() const override { return true; }
  bool isAvailable() const override { return true; }
  c10::DeviceIndex deviceCount() const override { return 1; }
};

bool is_second(const at::Tensor& x) { return x.defined() && x.device().type() == SECOND; }

// The same memory as a tensor of the CPU: of views too.
at::Tensor on_cpu(const at::Tensor& x) {
  if (!is_second(x)) return x;
  int64_t last = x.numel() ? x.storage_offset() + 1 : 0;
  for (int64_t d = 0; x.numel() && d < x.dim(); ++d) last += (x.size(d) - 1) * x.stride(d);
  TORCH_CHECK(last * static_cast<int64_t>(x.element_size()) <= static_cast<int64_t>(x.storage().nbytes()), "a tensor reaches beyond its memory");
  auto* holder = new c10::Storage(x.storage());
  c10::DataPtr data(holder->mutable_data(), holder, [](void* h) { delete static_cast<c10::Storage*>(h); }, at::kCPU);
  c10::Storage storage(c10::Storage::use_byte_size_t(), holder->nbytes(), std::move(data), c10::GetCPUAllocator(), true);
  auto same = at::detail::make_tensor<at::TensorImpl>(std::move(storage), c10::DispatchKeySet(c10::DispatchKey::CPU), x.dtype());
  same.unsafeGetTensorImpl()->set_sizes_and_strides(x.sizes(), x.strides(), x.storage_offset());
  if (x.is_conj()) same = same.conj();
  return same;
}

at::Tensor empty(at::SymIntArrayRef size, std::optional<at::ScalarType> type, std::optional<at::Layout>,
                 std::optional<at::Device>, std::optional<bool>, std::optional<at::MemoryFormat> format) {
  return at::detail::empty_generic(C10_AS_INTARRAYREF_SLOW(size), &memory, c10::DispatchKeySet(c10::DispatchKey::PrivateUse1),
                                   c10::dtype_or_default(type), format);
}

at::Tensor empty_strided(at::IntArrayRef size, at::IntArrayRef stride, std::optional<at::ScalarType> type,
                         std::optional<at::Layout>, std::optional<at::Device>, std::optional<bool>) {
  return at::detail::empty_strided_generic(size, stride, &memory, c10::DispatchKeySet(c10::DispatchKey::PrivateUse1),
                                           c10::dtype_or_default(type));
}

at::Tensor copy_from(const at::Tensor& from, const at::Tensor& to, bool) {
  on_cpu(to).copy_(on_cpu(from));
  return to;
}

const at::Tensor& resize(const at::Tensor& x, at::SymIntArrayRef size, std::optional<at::MemoryFormat>) {
  auto sizes = C10_AS_INTARRAYREF_SLOW(size);
  auto* impl = x.unsafeGetTensorImpl();
  at::native::resize_impl_cpu_(impl, sizes, std::nullopt);
  return x;
}

at::Scalar scalar(const at::Tensor& x) { return on_cpu(x).item(); }

at::Tensor& set_storage(at::Tensor& x, at::Storage storage, int64_t offset, at::IntArrayRef size, at::IntArrayRef stride) {
  at::native::checkSetStorage(x, storage, offset, size, stride);
  x.unsafeGetTensorImpl()->set_storage_offset(offset);
  at::native::resize_impl_cpu_(x.unsafeGetTensorImpl(), size, stride.data() ? at::OptionalIntArrayRef(stride) : std::nullopt, false);
  return x;
}

// Operations that take tensors of both, as on a GPU.
const std::set<std::string> MIXED = {"aten::index", "aten::index_put_", "aten::_index_put_impl_", "aten::copy_"};

void fallback(const c10::OperatorHandle& op, Stack* stack) {
  const auto& schema = op.schema();
  const auto count = schema.arguments().size();
  const size_t start = stack->size() - count;
  const bool mixes = MIXED.count(schema.name()) > 0;
  std::string cpu_one;
  bool any_second = false;
  auto look = [&](const at::Tensor& x, const std::string& name) {
    if (!x.defined()) return;
    if (x.device().type() == SECOND) any_second = true;
    else if (x.dim() > 0) cpu_one = name;
  };
  // Kept until the results are read: torch hands back references to several results after it has dropped the arguments.
  std::vector<at::Tensor> passed;
  auto cpu_tensor = [&](const at::Tensor& x) { return x.defined() ? passed.emplace_back(on_cpu(x)) : x; };
  std::vector<at::Tensor> originals(count);
  bool factory = false;
  for (size_t i = 0; i < count; ++i) {
    auto& value = (*stack)[start + i];
    const auto& name = schema.arguments()[i].name();
    if (value.isTensor()) {
      originals[i] = value.toTensor();
      look(originals[i], name);
      value = cpu_tensor(originals[i]);
    } else if (value.isTensorList()) {
      auto list = value.toTensorVector();
      for (auto& x : list) { look(x, name); x = cpu_tensor(x); }
      value = c10::List<at::Tensor>(list);
    } else if (value.isList() && value.toListRef().size() && (value.toListRef()[0].isTensor() || value.toListRef()[0].isNone()) &&
               value.type()->str().find("Tensor") != std::string::npos) {
      auto list = c10::List<std::optional<at::Tensor>>();
      for (const auto& x : value.toListRef()) {
        if (x.isNone()) { list.push_back(std::nullopt); continue; }
        look(x.toTensor(), name);
        list.push_back(cpu_tensor(x.toTensor()));
      }
      value = list;
    } else if (value.isDevice()) {
      if (value.toDevice().type() == SECOND) factory = true;
      value = c10::Device(at::kCPU);
    } else if (value.isGenerator()) {
      auto generator = value.toGenerator();
      if (generator.device().type() == SECOND)
        value = static_cast<Draws*>(generator.unsafeGetGeneratorImpl())->cpu;
      else
        TORCH_CHECK(false, schema.name(), ": expected a generator of the second device, got one of the CPU");
    }
  }
  TORCH_CHECK(cpu_one.empty() || !any_second || mixes, "Expected all tensors to be on the same device, but got ", cpu_one,
              " of ", schema.name(), " is on cpu, different from other tensors on second:0");
  op.callBoxed(stack);
  // What was written in place: the memory is the same. Results that are arguments are these; others move.
  const auto& returns = schema.returns();
  const size_t first = stack->size() - returns.size();
  for (size_t r = 0; r < returns.size(); ++r) {
    auto& value = (*stack)[first + r];
    auto* alias = returns[r].alias_info();
    bool replaced = false;
    if (alias && alias->isWrite()) {
      for (size_t i = 0; i < count && !replaced; ++i) {
        auto* of = schema.arguments()[i].alias_info();
        if (of && *of == *alias && originals[i].defined()) {
          auto result = value.toTensor();
          if (originals[i].sizes() != result.sizes()) {  // out= of another size
            originals[i].resize_(result.sizes());
            on_cpu(originals[i]).copy_(result);
          }
          value = originals[i];
          replaced = true;
        }
      }
    }
    if (replaced || !(any_second || factory)) continue;
    auto move = [](const at::Tensor& x) {
      if (!x.defined() || is_second(x)) return x;
      auto moved = at::empty_strided(x.sizes(), x.strides(), x.options().device(c10::Device(SECOND, 0)));
      on_cpu(moved).copy_(x);
      return moved;
    };
    if (value.isTensor()) value = move(value.toTensor());
    else if (value.isTensorList()) {
      auto list = value.toTensorVector();
      for (auto& x : list) x = move(x);
      value = c10::List<at::Tensor>(list);
    }
  }
}

TORCH_LIBRARY_IMPL(_, PrivateUse1, m) { m.fallback(torch::CppFunction::makeFromBoxedFunction<&fallback>()); }

TORCH_LIBRARY_IMPL(aten, PrivateUse1, m) {
  m.impl("empty.memory_format", empty);
  m.impl("empty_strided", empty_strided);
  m.impl("_copy_from", copy_from);
  m.impl("_copy_from_and_resize", [](const at::Tensor& from, const at::Tensor& to) {
    to.resize_(from.sizes());
    return copy_from(from, to, false);
  });
  m.impl("resize_", resize);
  m.impl("_local_scalar_dense", scalar);
  m.impl("as_strided", [](const at::Tensor& x, at::IntArrayRef size, at::IntArrayRef stride, std::optional<int64_t> offset) {
    return at::native::as_strided_tensorimpl(x, size, stride, offset);
  });
  m.impl("view", [](const at::Tensor& x, at::IntArrayRef size) { return at::native::view(x, size); });
  m.impl("_reshape_alias", [](const at::Tensor& x, at::IntArrayRef size, at::IntArrayRef stride) {
    return at::native::_reshape_alias(x, size, stride);
  });
  m.impl("convolution_overrideable",
         [](const at::Tensor& x, const at::Tensor& weight, const std::optional<at::Tensor>& bias, c10::SymIntArrayRef stride,
            c10::SymIntArrayRef padding, c10::SymIntArrayRef dilation, bool transposed, c10::SymIntArrayRef output_padding,
            c10::SymInt groups) {
           std::optional<at::Tensor> moved = bias.has_value() ? std::make_optional(on_cpu(*bias)) : std::nullopt;
           return at::convolution_symint(on_cpu(x), on_cpu(weight), moved, stride, padding, dilation, transposed,
                                         output_padding, groups).to(x.device());
         });
  m.impl("set_.source_Storage_storage_offset", set_storage);
  m.impl("set_.source_Storage", [](at::Tensor& x, at::Storage storage) -> at::Tensor& {
    int64_t size = static_cast<int64_t>(storage.nbytes() / x.element_size());
    return set_storage(x, std::move(storage), 0, {size}, {});
  });
}

const bool registered = [] { return at::RegisterPrivateUse1HooksInterface(new Hooks()), true; }();

}  // namespace
