#pragma once
#define MODULE_NAME "quadjax_policy"
#define PX4_OK 0
#define PX4_ERROR (-1)
#define __EXPORT __attribute__((visibility("default")))
#define PRINT_MODULE_DESCRIPTION(text) (void)(text)
#define PRINT_MODULE_USAGE_NAME(name, category) (void)(name)
#define PRINT_MODULE_USAGE_COMMAND(name) (void)(name)
#define PRINT_MODULE_USAGE_DEFAULT_COMMANDS() (void)0

template <class T> struct StubAtomic {
	T *value{nullptr};
	void store(T *to) { value = to; }
	T *load() const { return value; }
};

template <class T> class ModuleBase
{
public:
	virtual ~ModuleBase() = default;
	virtual int print_status() { return 0; }
	static int main(int argc, char *argv[]) { return T::task_spawn(argc, argv); }
	static T *instance() { return _object.load(); }
	void request_stop() { _stop = true; }
protected:
	bool should_exit() const { return _stop; }
	static void exit_and_cleanup() { delete _object.load(); _object.store(nullptr); }
	static StubAtomic<T> _object;
	static int _task_id;
	static constexpr int task_id_is_work_queue = -2;
	bool _stop{false};
};

template <class T> StubAtomic<T> ModuleBase<T>::_object{};
template <class T> int ModuleBase<T>::_task_id{-1};
