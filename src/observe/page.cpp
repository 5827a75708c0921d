// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "observe/page.h"

#include <fmt/format.h>
#include <malloc.h>

#include <charconv>
#include <cmath>
#include <nlohmann/json.hpp>
#include <optional>

#include "wire/envelope.h"
#include "wire/fields.h"

namespace vla::observe {
namespace {

using Json = nlohmann::ordered_json;

constexpr std::size_t kMaxAnswer = 40;  // acts in an answer
constexpr std::size_t kMaxSeen = 8;     // pictures that are kept for a second viewer

// Limits of what the page shows of an act: more than any policy has, and so little that a hostile act delays nobody.
constexpr std::size_t kMaxText = 4096, kMaxName = 256;  // bytes
constexpr std::size_t kMaxViews = 32, kMaxStates = 32, kMaxNotes = 32, kMaxStages = 64;
constexpr std::size_t kMaxValues = 1024, kMaxActions = 8192;           // numbers
constexpr std::size_t kMaxMessage = 64 << 10, kMaxResponse = 1 << 20;  // maximum bytes of a message that is parsed

constexpr const char* kForbidden = "open the address that vla serve has printed: it ends with a token\n";
constexpr const char* kNoFolder = "vla serve was started without a folder for recordings: --record DIR\n";

constexpr char kHtml[] =
#include "observe/page_html.inc"
    ;

std::string text_of(const Json& json) { return json.dump(-1, ' ', true, Json::error_handler_t::replace); }

std::string text_of(std::span<const std::byte> bytes) {
  return {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
}

/// The value of a name in `a=1&b=2`; empty if the name is missing. The page's own values need no escapes.
std::string_view value_of(std::string_view query, std::string_view name) {
  while (!query.empty()) {
    const std::string_view part = query.substr(0, query.find('&'));
    if (part.size() > name.size() && part.starts_with(name) && part[name.size()] == '=')
      return part.substr(name.size() + 1);
    query.remove_prefix(std::min(query.size(), part.size() + 1));
  }
  return {};
}

std::uint64_t number_of(std::string_view query, std::string_view name) {
  const std::string_view text = value_of(query, name);
  std::uint64_t number = 0;
  std::from_chars(text.data(), text.data() + text.size(), number);
  return number;
}

/// A view of an act. It points into the act's bytes.
struct View {
  std::span<const std::byte> message;
  std::string_view name;
  int image = 0;  // number of the field that holds it: rgb, jpeg, png or absent
  std::span<const std::byte> bytes;

  const char* kind() const {
    switch (image) {
      case v1::View::kRgbFieldNumber:
        return "rgb";
      case v1::View::kJpegFieldNumber:
        return "jpeg";
      case v1::View::kPngFieldNumber:
        return "png";
      default:
        return "absent";
    }
  }
};

/// Calls `use` for each field of a message, up to its end or to the first invalid field: a refused message is shown as
/// far as it is valid.
template <class Use>
void each_field(std::span<const std::byte> message, const Use& use) {
  for (wire::Fields field(message, "act");;) {
    const Result<bool> more = field.next();
    if (!more || !*more) return;
    use(field);
  }
}

std::string_view view_of(std::span<const std::byte> bytes) {
  return {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
}

View read_view(std::span<const std::byte> message) {
  View view{.message = message};
  each_field(message, [&view](const wire::Fields& field) {
    if (field.type != 'b') return;
    if (field.number == v1::View::kNameFieldNumber)
      view.name = view_of(field.value);
    else
      view.image = field.number, view.bytes = field.value;
  });
  return view;
}

Error no_recipe() { return {Code::unsupported, "recipe", "the bundle", "none", "give vla replay its --bundle"}; }

Json record_json(const Recordings& recordings) {
  const Recordings::Standing standing = recordings.standing();
  return {{"on", standing.on},       {"folder", standing.folder},           {"requests", standing.n_request},
          {"bytes", standing.bytes}, {"max_bytes", recordings.max_bytes()}, {"why", standing.why}};
}

/// A PPM file, which the page draws itself: encoding would cost more than everything else.
HttpReply pixmap(std::uint32_t width, std::uint32_t height, std::string_view rgb) {
  return {.type = "image/x-portable-pixmap", .body = fmt::format("P6 {} {} 255\n", width, height).append(rgb)};
}

Json dimensions_json(const google::protobuf::RepeatedPtrField<v1::Dimension>& dimensions) {
  Json json = Json::array();
  for (const v1::Dimension& dimension : dimensions)
    json.push_back({{"name", dimension.name()}, {"unit", dimension.unit()}});
  return json;
}

Json robot_json(const v1::Description& robot, const std::map<std::string, Page::Range>& ranges,
                const std::map<std::string, Page::Range>& limits) {
  Json json = {{"embodiment", robot.embodiment()},
               {"horizon", robot.horizon()},
               {"rate_hz", robot.rate_hz()},
               {"actions", dimensions_json(robot.actions())},
               {"states", Json::array()}};
  for (const v1::StateSpec& state : robot.states()) {
    Json one = {{"name", state.name()}, {"dimensions", dimensions_json(state.dimensions())}};
    if (const auto found = ranges.find(robot.embodiment() + "/" + state.name()); found != ranges.end())
      one["low"] = found->second.low, one["high"] = found->second.high;
    json["states"].push_back(std::move(one));
  }
  for (Json& action : json["actions"])
    if (const auto found = limits.find(action["name"]); found != limits.end())
      for (const auto& [key, end] : {std::pair{"low", found->second.low[0]}, {"high", found->second.high[0]}})
        if (std::isfinite(end)) action[key] = end;
  return json;
}

/// The beginning of a text, with `...` in place of the rest.
std::string beginning(std::string_view text, std::size_t size) {
  return text.size() <= size ? std::string(text) : std::string(text.substr(0, size)) + "...";
}

/// The first `count` elements of a repeated field, converted by `make`.
template <class Field, class Make>
Json first_of(const Field& field, std::size_t count, const Make& make) {
  Json json = Json::array();
  for (const auto& element : field) {
    if (json.size() == count) break;
    json.push_back(make(element));
  }
  return json;
}

Json number(float x) { return x; }
Json note_json(const std::string& note) { return beginning(note, kMaxText); }

Json chunk_json(const v1::ActionChunk& chunk) {
  const auto stage_json = [](const v1::Stage& stage) { return Json{beginning(stage.name(), kMaxName), stage.ms()}; };
  return {{"horizon", chunk.horizon()},
          {"d_action", chunk.d_action()},
          {"rate_hz", chunk.rate_hz()},
          {"actions", first_of(chunk.actions(), kMaxActions, number)},
          {"notes", first_of(chunk.notes(), kMaxNotes, note_json)},
          {"queue_ms", chunk.queue_ms()},
          {"stages", first_of(chunk.stages(), kMaxStages, stage_json)}};
}

/// Adds a state's values to `states`; `left`: how many values of the act may still be shown.
void add_state(std::span<const std::byte> message, Json& states, std::size_t& left) {
  v1::State state;
  if (states.size() == kMaxStates || message.size() > kMaxMessage ||
      !state.ParseFromArray(message.data(), static_cast<int>(message.size())))
    return;
  Json& values = states[beginning(state.name(), kMaxName)] = first_of(state.values(), left, number);
  left -= values.size();
}

Json loop_json(std::span<const std::byte> message) {
  v1::LoopState loop;
  if (message.size() > kMaxMessage || !loop.ParseFromArray(message.data(), static_cast<int>(message.size())))
    return nullptr;
  return {{"driver", v1::LoopState::Driver_Name(loop.driver())},
          {"actions", loop.actions()},
          {"human", loop.human()},
          {"held", loop.held()},
          {"missed", loop.missed()},
          {"limited", loop.limited()},
          {"refused", loop.refused()}};
}

Json act_json(std::span<const std::byte> act) {
  Json json = {{"text", nullptr}, {"embodiment", ""}, {"states", Json::object()}, {"views", Json::array()}};
  std::size_t n_value = kMaxValues;
  each_field(act, [&](const wire::Fields& field) {
    if (field.number == v1::Act::kDeadlineMsFieldNumber && field.type == 'v') json["deadline_ms"] = field.varint;
    if (field.type != 'b') return;
    if (field.number == v1::Act::kTextFieldNumber) json["text"] = beginning(view_of(field.value), kMaxText);
    if (field.number == v1::Act::kEmbodimentFieldNumber) json["embodiment"] = beginning(view_of(field.value), kMaxName);
    if (field.number == v1::Act::kLoopFieldNumber) json["loop"] = loop_json(field.value);
    if (field.number == v1::Act::kStatesFieldNumber) add_state(field.value, json["states"], n_value);
    if (field.number != v1::Act::kViewsFieldNumber || json["views"].size() == kMaxViews) return;
    const View view = read_view(field.value);
    json["views"].push_back({{"name", beginning(view.name, kMaxName)}, {"kind", view.kind()}});
  });
  return json;
}

/// Returns a raw frame as a pixmap; 404 if the number of pixels does not match its width and height.
HttpReply raw_frame(std::span<const std::byte> message) {
  std::uint64_t width = 0, height = 0;
  std::string_view rows;
  each_field(message, [&](const wire::Fields& field) {
    if (field.number == v1::RawRgb::kWidthFieldNumber) width = field.varint;
    if (field.number == v1::RawRgb::kHeightFieldNumber) height = field.varint;
    if (field.number == v1::RawRgb::kRowsFieldNumber && field.type == 'b') rows = view_of(field.value);
  });
  const bool is_whole =
      width > 0 && height > 0 && width <= rows.size() && height <= rows.size() && width * height * 3 == rows.size();
  if (!is_whole) return {.status = 404, .body = "pixels of other sides\n"};
  return pixmap(static_cast<std::uint32_t>(width), static_cast<std::uint32_t>(height), rows);
}

/// The memory that a string takes beside the object itself.
std::size_t on_heap(const std::string& text) {
  constexpr std::size_t kInside = 15, kMallocs = 16;
  return text.capacity() <= kInside ? 0 : text.capacity() + 1 + kMallocs;
}

}  // namespace

struct Page::Act {
  std::uint64_t id = 0;
  std::int64_t at_ms = 0;  // time of receipt, since 1970
  double total_ms = 0;     // from receipt to its answer
  std::string client, name, code;
  std::string in, out;
  std::size_t size = 0;  // in memory

  /// The serialized v1::Act; empty if the request is not an act.
  std::span<const std::byte> act() const {
    const auto request = std::as_bytes(std::span(in));
    wire::Envelope envelope;
    wire::read_envelope(request, envelope).ok();  // refused acts are shown too
    return envelope.kind == wire::Kind::act ? envelope.body(request) : std::span<const std::byte>();
  }

  std::string json() const {
    Json all = {{"id", id},         {"at_ms", at_ms}, {"total_ms", total_ms},
                {"client", client}, {"name", name},   {"code", code}};
    all.update(act_json(act()));
    v1::Response response;
    if (out.size() > kMaxResponse || !response.ParseFromString(out)) return text_of(all);
    if (response.has_chunk()) all["chunk"] = chunk_json(response.chunk());
    if (response.has_error())
      all["error"] = {{"where", note_json(response.error().where())},
                      {"expected", note_json(response.error().expected())},
                      {"found", note_json(response.error().found())}};
    return text_of(all);
  }

  /// The view of this number, or none.
  std::optional<View> view(std::size_t number) const {
    std::optional<View> found;
    each_field(act(), [&](const wire::Fields& field) {
      if (field.number == v1::Act::kViewsFieldNumber && field.type == 'b' && number-- == 0)
        found = read_view(field.value);
    });
    return found;
  }

  /// The act as if it had this view alone.
  v1::Act with(const View& view) const {
    v1::Act one;
    one.add_views()->ParseFromArray(view.message.data(), static_cast<int>(view.message.size()));
    each_field(act(), [&one](const wire::Fields& field) {
      if (field.number == v1::Act::kEmbodimentFieldNumber && field.type == 'b')
        one.set_embodiment(std::string(view_of(field.value)));
    });
    return one;
  }
};

Result<std::unique_ptr<Page>> Page::open(const std::string& address, bool insecure, Sources sources) {
  std::unique_ptr<Page> page(new Page(std::move(sources)));
  const auto handle = [page = page.get()](const std::string& path, const std::string& query) {
    return page->reply(path, query);
  };
  const auto handle_post = [page = page.get()](const std::string& path, const std::string& query) {
    return page->reply_to_post(path, query);
  };
  VLA_TRY(page->http_, Http::open(address, "--page", insecure, handle, handle_post));
  return page;
}

std::string Page::url() const { return fmt::format("http://{}/?token={}", address(), sources_.token); }

void Page::describe(const v1::Description& description, const std::map<std::string, Range>& ranges,
                    const std::map<std::string, Range>& limits, See see) {
  Json json = {{"bundle", description.bundle().name()},
               {"arch", description.bundle().arch()},
               {"device", description.runtime().device()},
               {"precision", description.runtime().precision()},
               {"kernels", description.runtime().kernels()},
               {"sees", see != nullptr},
               {"robots", Json::array()}};
  for (const v1::Description& robot : description.embodiments())
    json["robots"].push_back(robot_json(robot, ranges, limits));
  if (json["robots"].empty()) json["robots"].push_back(robot_json(description, ranges, limits));
  const std::lock_guard lock(mutex_);
  policy_ = text_of(json);
  see_ = std::move(see);
}

void Page::answered(const Answered& answered) try {
  if (answered.request.kind != Kind::act || answered.out.empty()) return;
  const auto act = std::make_shared<Act>();
  const auto age = Clock::now() - answered.request.at;
  const auto at = std::chrono::system_clock::now() - age;
  act->at_ms = std::chrono::duration_cast<std::chrono::milliseconds>(at.time_since_epoch()).count();
  act->total_ms = std::chrono::duration<double, std::milli>(answered.sent - answered.request.at).count();
  act->client = answered.request.client, act->name = answered.request.name, act->code = answered.code();
  keep(act, answered.in, answered.out);
} catch (const std::exception&) {  // no memory: viewers miss this one
}

bool Page::show(const Recording::Record& record) {
  v1::Response response;
  response.ParseFromString(record.response);
  if (!response.has_chunk() && !response.has_error()) return false;
  const auto act = std::make_shared<Act>();
  act->at_ms = static_cast<std::int64_t>(record.at_ns / 1'000'000);
  act->total_ms = response.chunk().queue_ms() + response.chunk().engine_ms();
  act->client = fmt::format("{:08x}", record.client >> 32);
  act->code = response.has_error() ? code_name(wire::code_of(response.error().code())) : "ok";
  keep(act, std::as_bytes(std::span(record.request)), std::as_bytes(std::span(record.response)));
  return true;
}

void Page::keep(const std::shared_ptr<Act>& act, std::span<const std::byte> in, std::span<const std::byte> out) {
  constexpr std::size_t kRoom = sizeof(Act) + 64;  // adds reference counts, its place in `acts_` and malloc's overhead
  if (in.size() + out.size() > kMaxBytes) return;
  act->in = text_of(in), act->out = text_of(out);
  act->size = kRoom;
  for (const std::string* text : {&act->client, &act->name, &act->code, &act->in, &act->out})
    act->size += on_heap(*text);
  {
    const std::lock_guard lock(mutex_);
    acts_.push_back(act);
    act->id = ++n_act_;
    bytes_ += act->size;
    for (; bytes_ > kMaxBytes; acts_.pop_front()) bytes_ -= acts_.front()->size;
  }
  if (act->size > kMaxBytes / 16) ::malloc_trim(0);  // returns the memory of the many small acts that it replaced
}

bool Page::may_ask(const std::string& query) const {
  return sources_.is_same(value_of(query, "token"), sources_.token);
}

HttpReply Page::reply(const std::string& path, const std::string& query) {
  if (!may_ask(query)) return {.status = 403, .body = kForbidden};
  if (path == "/") return {.type = "text/html; charset=utf-8", .body = kHtml};
  if (path == "/acts") return acts_after(number_of(query, "after"));
  if (path == "/image")
    return image(number_of(query, "act"), number_of(query, "view"), value_of(query, "as") == "seen");
  if (path != "/policy") return {.status = 404, .body = "not here\n"};
  const std::lock_guard lock(mutex_);
  return {.type = "application/json", .body = policy_};
}

HttpReply Page::reply_to_post(const std::string& path, const std::string& query) {
  if (!may_ask(query)) return {.status = 403, .body = kForbidden};
  const std::string_view on = value_of(query, "on");
  if (path != "/record" || (on != "0" && on != "1")) return {.status = 404, .body = "not here\n"};
  if (sources_.recordings == nullptr) return {.status = 409, .body = kNoFolder};
  const Status done = on == "1" ? sources_.recordings->begin() : sources_.recordings->end();
  if (!done) return {.status = 409, .body = done.error().message() + "\n"};
  return {.type = "application/json", .body = text_of(record_json(*sources_.recordings))};
}

/// The newest acts after this one, oldest first.
HttpReply Page::acts_after(std::uint64_t id) {
  std::vector<std::shared_ptr<Act>> found;
  std::uint64_t first = 0, last = 0;
  {
    const std::lock_guard lock(mutex_);
    last = n_act_, first = n_act_ + 1 - acts_.size();
    for (auto act = acts_.rbegin(); act != acts_.rend() && (*act)->id > id && found.size() < kMaxAnswer; ++act)
      found.push_back(*act);
  }
  const Health health = sources_.health();
  Json record;  // null if the page shows a recording
  if (sources_.is_server) record = sources_.recordings ? record_json(*sources_.recordings) : Json{{"on", false}};
  const Json json = {{"ready", health.ready},
                     {"waiting", health.n_waiting},
                     {"computing", health.computing},
                     {"chunks", health.n_chunk},
                     {"errors", health.n_error},
                     {"uptime_s", health.uptime_s},
                     {"first", first},
                     {"last", last},
                     {"record", record}};
  std::string body = text_of(json);
  body.back() = ',';
  body += "\"acts\":[";
  for (auto act = found.rbegin(); act != found.rend(); ++act)
    body += (act == found.rbegin() ? "" : ",") + (*act)->json();
  return {.type = "application/json", .body = body + "]}"};
}

const Result<Frame>& Page::seen(const Act& act, std::size_t view) {
  for (const Seen& kept : seen_)
    if (kept.act == act.id && kept.view == view) return kept.picture;
  See see;
  {
    const std::lock_guard lock(mutex_);
    see = see_;
  }
  seen_.push_back({act.id, view, see ? see(act.with(*act.view(view)), 0) : no_recipe()});
  if (seen_.size() > kMaxSeen) seen_.pop_front();
  return seen_.back().picture;
}

HttpReply Page::image(std::uint64_t id, std::size_t number, bool as_seen) {
  std::shared_ptr<Act> act;
  {
    const std::lock_guard lock(mutex_);
    if (!acts_.empty() && id >= acts_.front()->id && id <= n_act_) act = acts_[id - acts_.front()->id];
  }
  const std::optional<View> view = act ? act->view(number) : std::nullopt;
  if (!view) return {.status = 404, .body = "gone, or never there\n"};
  if (as_seen) {
    const Result<Frame>& picture = seen(*act, number);
    if (!picture) return {.status = 404, .body = picture.error().message() + "\n"};
    const auto& rgb = std::get<std::vector<std::uint8_t>>(picture->rgb);
    return pixmap(static_cast<std::uint32_t>(picture->width), static_cast<std::uint32_t>(picture->height),
                  view_of(std::as_bytes(std::span(rgb))));
  }
  const std::string kind = view->kind();
  if (kind == "rgb") return raw_frame(view->bytes);
  if (kind == "absent") return {.status = 404, .body = "absent\n"};
  return {.type = "image/" + kind, .body = text_of(view->bytes)};
}

}  // namespace vla::observe
