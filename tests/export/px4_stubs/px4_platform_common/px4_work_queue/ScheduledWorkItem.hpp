#pragma once
#include <stdint.h>
namespace px4
{
struct wq_config_t {
	const char *name;
};
namespace wq_configurations
{
static constexpr wq_config_t rate_ctrl{"wq:rate_ctrl"};
}
class ScheduledWorkItem
{
public:
	ScheduledWorkItem(const char *, const wq_config_t &) {}
	virtual ~ScheduledWorkItem() = default;
	void ScheduleOnInterval(uint32_t us) { interval = us; }
	void ScheduleClear() { interval = 0; }
	void stub_run() { Run(); }
	uint32_t interval{0};
protected:
	virtual void Run() = 0;
};
}
